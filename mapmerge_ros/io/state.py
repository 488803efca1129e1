# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
The state of a fusion in one file: a recording of its sub-maps, and a note on where it was.

Any tool that reads recordings reads the sub-maps; the note is a metadata record of the mcap file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader

from mapmerge_ros.arrays import Floats
from mapmerge_ros.fusion import Snapshot
from mapmerge_ros.fusion.component import Anchor
from mapmerge_ros.fusion.requests import Denial
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.io.bags import BagError, Recorded, read_submaps
from mapmerge_ros.io.recorder import record

FORMAT = 1
"""Version of the note; a reader refuses those it does not know."""

NOTE = 'mapmerge_state'
"""Name of the metadata record."""

TOPIC = '/submaps'


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
        The file cannot be read, holds no sub-maps, or is of a later version.

    """
    path = Path(path)
    found = list(read_submaps(path))
    note = _read_note(path) if path.suffix == '.mcap' and path.is_file() else None
    submaps = tuple(item.submap for item in found if item.submap is not None)
    refused = tuple(item for item in found if item.submap is None)
    try:
        state = Snapshot(submaps, revision=0) if note is None else _noted(note, submaps)
    except (ValueError, KeyError, TypeError) as err:
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
        return dict(json.loads(note['state']))
    except (KeyError, ValueError) as err:
        raise BagError(f'{path}: its state is damaged: {err}') from err


def _note(state: Snapshot) -> dict[str, Any]:
    anchor = state.anchor
    return {
        'revision': state.revision,
        'anchor': None
        if anchor is None
        else {
            'map_id': anchor.map_id,
            'scale': anchor.S_global_map.scale,
            'rotation': anchor.S_global_map.rotation.tolist(),
            'translation': anchor.S_global_map.translation.tolist(),
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
        anchor=None if anchor is None else Anchor(anchor['map_id'], _similarity(anchor)),
        revision=int(note['revision']),
        denied={
            map_id: Denial(np.array(item['landmark_ids'], np.uint64), int(item['capacity']))
            for map_id, item in note['denied'].items()
        },
    )


def _similarity(item: dict[str, Any]) -> Similarity:
    rotation: Floats = np.array(item['rotation'], np.float64)
    return Similarity(float(item['scale']), rotation, np.array(item['translation'], np.float64))
