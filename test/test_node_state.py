# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Saved and loaded, killed and restarted, paused: no map has to be sent twice."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ros_processes import FUSION, Observer, spin_for, spin_until
from std_srvs.srv import SetBool

from mapmerge_ros.cli.processes import Children
from mapmerge_ros.fusion import FusionConfig, FusionEngine, State
from mapmerge_ros.io import read_submaps, write_submaps
from mapmerge_ros.io.state import load_state, save_state
from mapmerge_ros.submap import SubMap

SHARP = FusionConfig(convergence=1e-6)
"""What is left of the last step is rounding."""

srv = pytest.importorskip('mapmerge_msgs.srv')


def test_after_kill_9_the_map_is_the_same_and_nothing_is_sent_again(
    children: Children, observer: Observer, drones: tuple[SubMap, ...], tmp_path: Path
) -> None:
    first = children.start('fusion', FUSION, {'merge_period': 0.2})
    # Volatile: what was sent is gone for who comes later.
    observer.send('/submaps', drones[0], latched=False)
    spin_until([observer], lambda: observer.heard_by('/submaps'), 'connected')
    for submap in drones:
        observer.send('/submaps', submap, latched=False)
    spin_until([observer], lambda: observer.merged == len(drones), 'all merged')
    before, file = observer.heard.global_map, tmp_path / 'state.mcap'
    assert before is not None
    assert observer.call(srv.SaveMap, 'save_map', path=str(file)).result == 0
    first.send_signal(signal.SIGKILL)
    assert first.wait(10) == -signal.SIGKILL

    children.start('again', FUSION, {'merge_period': 0.2})
    heard = observer.call(srv.LoadMap, 'load_map', path=str(file))
    assert (heard.result, heard.sub_maps, heard.message) == (0, len(drones), '')
    spin_until(
        [observer],
        lambda: (
            observer.heard.is_complete
            and observer.heard.global_map.revision > before.revision
            and observer.heard.status.merged == len(drones)
        ),
        'a later revision of the map',
    )
    after = observer.heard.global_map
    assert after is not None
    np.testing.assert_array_equal(after.landmark_ids, before.landmark_ids)
    np.testing.assert_allclose(after.points, before.points, rtol=1e-7, atol=1e-7)
    assert after.sources == before.sources
    assert observer.heard.status.messages_received == 0


def test_results_of_save_and_load(
    children: Children, observer: Observer, drones: tuple[SubMap, ...], tmp_path: Path
) -> None:
    children.start('fusion', FUSION, {'merge_period': 3600})
    save, read = srv.SaveMap.Response, srv.LoadMap.Response

    def saved(path: str) -> int:
        return int(observer.call(srv.SaveMap, 'save_map', path=path).result)

    def loaded(path: str) -> tuple[int, int]:
        response = observer.call(srv.LoadMap, 'load_map', path=path)
        assert bool(response.message) == bool(response.result)
        return response.result, response.sub_maps

    file = tmp_path / 'x.mcap'
    assert saved(str(file)) == save.RESULT_NOTHING_TO_SAVE
    assert loaded(str(file)) == (read.RESULT_NOT_FOUND, 0)
    assert loaded('') == (read.RESULT_NOT_FOUND, 0)
    (tmp_path / 'bad.mcap').write_bytes(b'no bag')
    assert loaded(str(tmp_path / 'bad.mcap')) == (read.RESULT_BAD_FORMAT, 0)
    plain = tmp_path / 'plain.mcap'
    write_submaps(plain, [('/a/submap', 1, drones[0]), ('/b/submap', 2, drones[1])])
    assert loaded(str(plain)) == (read.RESULT_SUCCESS, 2)
    assert loaded(str(plain)) == (read.RESULT_REFUSED, 0)
    assert saved(str(tmp_path / 'missing' / 'x.mcap')) == save.RESULT_PATH_NOT_WRITABLE
    assert saved(str(tmp_path / 'x.bag')) == save.RESULT_PATH_NOT_WRITABLE
    assert saved(str(file)) == save.RESULT_SUCCESS
    assert sorted(path.name for path in tmp_path.glob('x*')) == ['x.mcap']
    assert {item.submap.map_id for item in read_submaps(file) if item.submap} == {
        drones[0].map_id,
        drones[1].map_id,
    }


def test_paused_it_receives_and_does_not_merge(
    children: Children, observer: Observer, drones: tuple[SubMap, ...]
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.05})
    assert observer.call(SetBool, 'pause', data=True).success
    for submap in drones[:2]:
        observer.send('/submaps', submap)
    spin_until([observer], lambda: observer.node_values.get('sub_maps') == '2', 'received')
    spin_for([observer], 0.3)
    assert observer.heard.status is None
    assert observer.node_values['mode'] == 'paused'
    assert observer.merge_now().status.merged == 2
    assert observer.call(SetBool, 'pause', data=False).success
    observer.send('/submaps', drones[2])
    spin_until([observer], lambda: observer.merged == 3, 'it goes on')


def test_an_engine_goes_on_where_another_one_was(
    drones: tuple[SubMap, ...], tmp_path: Path
) -> None:
    engine, file = FusionEngine(SHARP, revision=41), tmp_path / 'state.mcap'
    engine.add(drones[1])
    engine.fuse()
    for submap in drones:
        engine.add(submap)
    engine.fuse()
    save_state(file, engine.state(), 0)
    raw = file.read_bytes()
    save_state(file, engine.state(), 0)
    assert file.read_bytes() == raw

    other = FusionEngine(SHARP)
    saved = load_state(file)
    assert saved.has_note
    receipts = other.restore(saved.state)
    assert all(receipt.accepted for receipt in receipts)
    assert other.state().revision == engine.state().revision == 43
    ours, theirs = engine.fuse().global_map, other.fuse().global_map
    assert ours is not None
    assert theirs is not None
    # The one starts at the map that it has made, the other anew: equal but for rounding.
    np.testing.assert_array_equal(ours.landmark_ids, theirs.landmark_ids)
    np.testing.assert_allclose(ours.points, theirs.points, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(ours.packed_r, theirs.packed_r, rtol=1e-6, atol=1e-6)
    assert (ours.sources, ours.dof) == (theirs.sources, theirs.dof)
    assert ours.a == pytest.approx(theirs.a, rel=1e-12)


def frames(engine: FusionEngine) -> dict[str, float]:
    return {
        item.submap.map_id: item.S_global_map.scale
        for item in engine.fuse().alignments
        if item.state is State.MERGED
    }


def test_the_frame_of_a_file_is_taken_over_where_nothing_is(
    drones: tuple[SubMap, ...], tmp_path: Path
) -> None:
    """Also where others were merged before and have gone, or the anchor goes before any merge."""
    file, engine = tmp_path / 'state.mcap', FusionEngine()
    engine.add(drones[2])
    engine.fuse()
    for submap in drones:
        engine.add(submap)
    expected = frames(engine)
    save_state(file, engine.state(), 0)

    emptied = FusionEngine()
    for submap in drones:
        emptied.add(submap)
    assert frames(emptied)[drones[0].map_id] != pytest.approx(expected[drones[0].map_id], rel=1e-3)
    emptied.remove([submap.map_id for submap in drones])
    emptied.restore(load_state(file).state)
    assert frames(emptied) == pytest.approx(expected, rel=1e-6)

    without_anchor, anchor = FusionEngine(), engine.state().anchor
    without_anchor.restore(load_state(file).state)
    assert anchor is not None
    without_anchor.remove([anchor.map_id])
    found = frames(without_anchor)
    assert len(found) == 3
    assert found == pytest.approx({name: expected[name] for name in found}, rel=5e-3)
    alone = FusionEngine()
    for submap in drones:
        if submap.map_id != anchor.map_id:
            alone.add(submap)
    assert frames(alone) != pytest.approx(found, rel=5e-3)


def test_a_restarted_robot_may_count_anew(drones: tuple[SubMap, ...]) -> None:
    engine, first = FusionEngine(), replace(drones[0], revision=7)
    assert engine.add(first).accepted
    late = replace(first, revision=3)
    assert not engine.add(late).accepted, 'a late message'
    repeated = replace(first, stamp_ns=first.stamp_ns + 10**9)
    assert not engine.add(repeated).accepted, 'the same map, stamped anew'
    again = replace(first, revision=1, stamp_ns=first.stamp_ns + 10**9)
    receipt = engine.add(again)
    assert receipt.accepted
    assert receipt.restarted
    assert not engine.add(first).restarted
