# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
The state of a fusion in one file: a recording of its sub-maps, and a note on where it was.

Any tool that reads recordings reads the sub-maps; the note is a metadata record of the mcap file.
"""

from __future__ import annotations

import json
import operator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader

from mapmerge_ros.arrays import Floats, Ids
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import Snapshot
from mapmerge_ros.fusion.requests import Denial
from mapmerge_ros.fusion.solution import Anchor
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.io.bags import BagError, Recorded, read_submaps
from mapmerge_ros.io.recorder import record

FORMAT = 1
"""Version of the note; a reader refuses those it does not know."""

NOTE = 'mapmerge_state'
"""Name of the metadata record."""

TOPIC = '/submaps'

LAST_REVISION = 2**32 - 2**28
"""Largest revision to go on from: a merge per second has numbers for another eight years."""

ORTHOGONAL = 1e-6
"""Largest entry of R'R - I of what is called a rotation; what was written has 1e-15."""

_DAMAGE = (ValueError, KeyError, TypeError, AttributeError, ArithmeticError, InvalidValue)
"""What reading a note raises that has other things in it than a note has."""


@dataclass(frozen=True, slots=True, eq=False)
class SavedState:
    """What a file holds."""

    state: Snapshot
    refused: tuple[Recorded, ...]
    """Messages inside that failed the checks"""
    has_note: bool
    """Whether it was saved by a fusion; a plain recording was not"""


def save_state(path: str | Path, state: Snapshot, time_ns: int) -> None:
    """
    Write a state as a whole or not at all, over an older file too.

    Raises
    ------
    OutputError
        The name does not end in .mcap, or the file cannot be written.

    """
    with record(path) as recorder:
        for submap in state.submaps:
            recorder.write_submap(TOPIC, time_ns, submap)
        recorder.note(NOTE, {'format': str(FORMAT), 'state': json.dumps(_note(state))})


def load_state(path: str | Path) -> SavedState:
    """
    Read what `save_state` wrote, or the newest sub-maps of any recording.

    Raises
    ------
    BagError
        The file cannot be read, holds no sub-maps, is of a later version, or its note is damaged.

    """
    path = Path(path)
    found = list(read_submaps(path))
    note = _read_note(path) if path.suffix == '.mcap' and path.is_file() else None
    submaps = tuple(item.submap for item in found if item.submap is not None)
    refused = tuple(item for item in found if item.submap is None)
    try:
        state = Snapshot(submaps, revision=0) if note is None else _noted(note, submaps)
    except _DAMAGE as err:
        raise BagError(f'{path}: its state is damaged: {err}') from err
    return SavedState(state, refused, note is not None)


def _read_note(path: Path) -> dict[str, Any] | None:
    try:
        with path.open('rb') as stream:
            records = [x for x in make_reader(stream).iter_metadata() if x.name == NOTE]
    except (OSError, McapError) as err:
        raise BagError(f'{path}: {err}') from err
    if not records:
        return None
    note = records[-1].metadata
    if note.get('format') != str(FORMAT):
        raise BagError(
            f'{path}: state of format {note.get("format")}, this version reads {FORMAT}: update'
        )
    try:
        return _object(json.loads(note['state']))
    except (*_DAMAGE, RecursionError) as err:
        raise BagError(f'{path}: its state is damaged: {err}') from err


def _note(state: Snapshot) -> dict[str, Any]:
    anchor = state.anchor
    return {
        'revision': state.revision,
        'anchor': None
        if anchor is None
        else {'map_id': anchor.map_id, **_frame(anchor.S_global_map)},
        'frames': {
            map_id: _frame(S_global_map) for map_id, S_global_map in sorted(state.frames.items())
        },
        'denied': {
            map_id: {'landmark_ids': denial.landmark_ids.tolist(), 'capacity': denial.capacity}
            for map_id, denial in sorted(state.denied.items())
        },
    }


def _noted(note: dict[str, Any], submaps: Any) -> Snapshot:
    anchor = note['anchor']
    return Snapshot(
        submaps,
        anchor=None if anchor is None else Anchor(_name(anchor['map_id']), _similarity(anchor)),
        revision=_whole('revision', note['revision'], LAST_REVISION),
        denied={map_id: _denial(item) for map_id, item in note['denied'].items()},
        # Files of before had none: then only the anchor's robot holds the frame.
        frames={map_id: _similarity(item) for map_id, item in note.get('frames', {}).items()},
    )


def _denial(item: dict[str, Any]) -> Denial:
    largest_id = int(np.iinfo(np.uint64).max)
    ids: Ids = np.array(
        [_whole('landmark_ids', value, largest_id) for value in item['landmark_ids']], np.uint64
    )
    return Denial(ids, _whole('capacity', item['capacity'], 2**32 - 1))


def _frame(S_global_map: Similarity) -> dict[str, Any]:
    return {
        'scale': S_global_map.scale,
        'rotation': S_global_map.rotation.tolist(),
        'translation': S_global_map.translation.tolist(),
    }


def _similarity(item: dict[str, Any]) -> Similarity:
    rotation: Floats = np.array(item['rotation'], np.float64)
    translation: Floats = np.array(item['translation'], np.float64)
    found = Similarity(float(item['scale']), rotation, translation)
    is_turn = np.allclose(rotation.T @ rotation, np.eye(3), rtol=0.0, atol=ORTHOGONAL)
    if not is_turn or np.linalg.det(rotation) < 0.0:
        raise InvalidValue('rotation: this matrix is none')
    return found


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InvalidValue(f'an object was expected, not {str(value)[:80]}')
    return value


def _name(value: Any) -> str:
    if not isinstance(value, str):
        raise InvalidValue(f'map_id: {str(value)[:80]} is no name')
    return value


def _whole(name: str, value: Any, largest: int) -> int:
    """Check a number that JSON may have as anything: a fraction is none."""
    number = operator.index(value)
    if not 0 <= number <= largest:
        raise InvalidValue(f'{name}: {number} is not between 0 and {largest}')
    return number
