# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Saved states that are odd, or not there: told, and nothing is taken in."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mapmerge_ros.fusion import FusionEngine
from mapmerge_ros.io import BagError, record
from mapmerge_ros.io.state import LAST_REVISION, NOTE, TOPIC, load_state, save_state
from mapmerge_ros.submap import SubMap

srv = pytest.importorskip('mapmerge_msgs.srv')


def test_a_state_of_a_later_version_is_refused(
    drones: tuple[SubMap, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mapmerge_ros.io import state

    engine, file = FusionEngine(), tmp_path / 'state.mcap'
    engine.add(drones[0])
    with monkeypatch.context() as later:
        later.setattr(state, 'FORMAT', 2)
        save_state(file, engine.state(), 0)
    with pytest.raises(BagError, match='format 2'):
        load_state(file)


ANCHOR = {
    'map_id': 'drone0/0001',
    'scale': 2.0,
    'rotation': np.eye(3).tolist(),
    'translation': [0.0, 0.0, 0.0],
}


def note(**changes: Any) -> str:
    return json.dumps({'revision': 5, 'anchor': ANCHOR, 'denied': {}, **changes})


def anchored(**changes: Any) -> str:
    return note(anchor={**ANCHOR, **changes})


def denying(**changes: Any) -> str:
    return note(denied={'drone0/0001': {'landmark_ids': [1], 'capacity': 3, **changes}})


ODD_NOTES = {
    'a number': '5',
    'null': 'null',
    'a list': '[]',
    'not JSON': '{',
    'deep': '[' * 100_000,
    'no denied': json.dumps({'revision': 5, 'anchor': None}),
    'denied is a list': note(denied=[]),
    'a negative id': denying(landmark_ids=[-1]),
    'an id of 65 bits': denying(landmark_ids=[2**64]),
    'a fraction of an id': denying(landmark_ids=[1.5]),
    'a capacity below 0': denying(capacity=-1),
    'anchor is a text': note(anchor='x'),
    'anchor without a name': anchored(map_id=[]),
    'scale is nan': anchored(scale=float('nan')),
    'scale is negative': anchored(scale=-1.0),
    'rotation of two rows': anchored(rotation=[[1, 2], [3, 4]]),
    'rotation is 0': anchored(rotation=np.zeros((3, 3)).tolist()),
    'rotation mirrors': anchored(rotation=(-np.eye(3)).tolist()),
    'translation of two': anchored(translation=[0.0, 0.0]),
    'revision too large': note(revision=2**32),
    'revision that leaves none': note(revision=2**32 - 2),
    'revision below 0': note(revision=-5),
    'revision infinite': note(revision=float('inf')),
}


def write_noted(path: Path, submap: SubMap, raw: str) -> None:
    with record(path) as recorder:
        recorder.write_submap(TOPIC, 0, submap)
        recorder.note(NOTE, {'format': '1', 'state': raw})


def loading() -> tuple[FusionEngine, Callable[[str], tuple[int, str]]]:
    """An engine, and the service that loads into it: path to result and message."""
    from mapmerge_ros.nodes.ledger import Ledger
    from mapmerge_ros.nodes.saving import Saving

    engine = FusionEngine(revision=41)
    saving = Saving(engine, Ledger(), lambda: 0)

    def load(path: str) -> tuple[int, str]:
        found = saving.load_map(SimpleNamespace(path=path), srv.LoadMap.Response())
        return int(found.result), str(found.message)

    return engine, load


@pytest.mark.parametrize('name', ODD_NOTES)
def test_a_state_with_an_odd_note_changes_nothing(
    name: str, drones: tuple[SubMap, ...], tmp_path: Path
) -> None:
    file = tmp_path / 'state.mcap'
    write_noted(file, drones[0], ODD_NOTES[name])
    engine, load = loading()
    result, message = load(str(file))
    assert (result, 'damaged' in message) == (srv.LoadMap.Response.RESULT_BAD_FORMAT, True)
    state = engine.state()
    assert (state.submaps, state.anchor, state.revision, engine.changed) == ((), None, 41, False)
    with pytest.raises(BagError, match='damaged'):
        load_state(file)


def test_the_notes_that_are_made_odd_are_whole_before(
    drones: tuple[SubMap, ...], tmp_path: Path
) -> None:
    file = tmp_path / 'state.mcap'
    for raw in (note(), anchored(), denying(landmark_ids=[2**64 - 1])):
        write_noted(file, drones[0], raw)
        assert load_state(file).state.anchor is not None
    write_noted(file, drones[0], note(revision=LAST_REVISION))
    engine = FusionEngine()
    engine.restore(load_state(file).state)
    merged = engine.fuse().global_map
    assert merged is not None
    assert merged.revision == LAST_REVISION + 1


def test_a_path_that_cannot_be_looked_at_is_not_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    not_found = srv.LoadMap.Response.RESULT_NOT_FOUND
    _, load = loading()
    result, message = load(str(tmp_path / ('x' * 300 + '.mcap')))
    assert (result, 'too long' in message) == (not_found, True)
    assert load('a\0b')[0] == not_found

    def closed(path: Path, **options: Any) -> None:
        raise PermissionError(13, 'Permission denied')

    monkeypatch.setattr(Path, 'stat', closed)
    result, message = load('/closed/state.mcap')
    assert (result, 'ermission denied' in message) == (not_found, True)
