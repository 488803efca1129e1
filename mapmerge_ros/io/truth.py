# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Truth beside a simulated recording: `drones.truth.json` for `drones.mcap`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mapmerge_ros.arrays import Ids
from mapmerge_ros.errors import InvalidValue, MapMergeError
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.io.comparison import TruthComparison, compare_with_truth
from mapmerge_ros.io.output import replacing
from mapmerge_ros.io.true_values import RecordingTruth, TrueMap, TrueMove, TrueStay

__all__ = [
    'RecordingTruth',
    'TrueMap',
    'TrueMove',
    'TrueStay',
    'TruthComparison',
    'TruthError',
    'compare_with_truth',
    'load_truth',
    'save_truth',
    'truth_json',
    'truth_path',
]


class TruthError(MapMergeError):
    """A file of truth cannot be read; the message names file and field."""


def truth_path(recording: Path) -> Path:
    """Where the truth of a recording is."""
    stem = recording.name.removesuffix('.mcap')
    return recording.with_name(f'{stem}.truth.json')


def save_truth(path: Path, truth: RecordingTruth) -> None:
    """
    Write a file of truth.

    Raises
    ------
    OutputError
        It cannot be written.

    """
    with replacing(path) as stream:
        stream.write(truth_json(truth))


def truth_json(truth: RecordingTruth) -> bytes:
    """Text of a file of truth."""
    return json.dumps(_to_plain(truth), allow_nan=False).encode()


def load_truth(path: Path) -> RecordingTruth:
    """
    Read a file of truth.

    Raises
    ------
    TruthError
        No such file, no JSON, or a field is missing or wrong.

    """
    try:
        return _from_plain(json.loads(path.read_text(encoding='utf-8')))
    except OSError as err:
        raise TruthError(f'{path}: {err.strerror}: check the path') from err
    except (json.JSONDecodeError, UnicodeDecodeError) as err:
        raise TruthError(f'{path}: not a JSON file: {err}') from err
    except KeyError as err:
        raise TruthError(f'{path}: field {err} is missing: simulate again') from err
    except (InvalidValue, ValueError, TypeError, OverflowError, AttributeError) as err:
        raise TruthError(f'{path}: {err}: simulate again') from err


def _to_plain(truth: RecordingTruth) -> dict[str, Any]:
    return {
        'landmarks': {
            'ids': truth.landmark_ids.tolist(),
            'points': truth.points_world.tolist(),
        },
        'maps': [_map_to_plain(true_map) for true_map in truth.maps],
        'moved': [
            {
                'landmarks': move.landmark_ids.tolist(),
                'map_ids': list(move.map_ids),
                'displacement': move.displacement_world.tolist(),
            }
            for move in truth.moved
        ],
        'temporary': [
            {'landmarks': stay.landmark_ids.tolist(), 'map_ids': list(stay.map_ids)}
            for stay in truth.temporary
        ],
    }


def _map_to_plain(true_map: TrueMap) -> dict[str, Any]:
    S_world_map = true_map.S_world_map
    plain: dict[str, Any] = {
        'map_id': true_map.map_id,
        'robot_id': true_map.robot_id,
        'world_from_map': {
            'scale': S_world_map.scale,
            'rotation': S_world_map.rotation.tolist(),
            'translation': S_world_map.translation.tolist(),
        },
    }
    if len(true_map.own_ids):
        plain['own_ids'] = true_map.own_ids.tolist()
        plain['true_ids'] = true_map.true_ids.tolist()
    return plain


def _from_plain(plain: dict[str, Any]) -> RecordingTruth:
    return RecordingTruth(
        landmark_ids=_ids(plain['landmarks']['ids']),
        points_world=np.array(plain['landmarks']['points'], float).reshape(-1, 3),
        maps=tuple(_map_from_plain(entry) for entry in plain['maps']),
        moved=tuple(
            TrueMove(_ids(entry['landmarks']), tuple(entry['map_ids']), entry['displacement'])
            for entry in plain['moved']
        ),
        temporary=tuple(
            TrueStay(_ids(entry['landmarks']), tuple(entry['map_ids']))
            for entry in plain.get('temporary', [])
        ),
    )


def _map_from_plain(plain: dict[str, Any]) -> TrueMap:
    frame = plain['world_from_map']
    return TrueMap(
        map_id=str(plain['map_id']),
        robot_id=str(plain['robot_id']),
        S_world_map=Similarity(frame['scale'], frame['rotation'], frame['translation']),
        own_ids=_ids(plain.get('own_ids', [])),
        true_ids=_ids(plain.get('true_ids', [])),
    )


def _ids(values: Sequence[int]) -> Ids:
    return np.array(values, np.uint64)
