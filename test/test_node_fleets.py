# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whole fleets: robots that come in any order, leave and begin again; two fleets at once."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ros_processes import FUSION, ROBOT, Observer, spin_until
from scenes import random_bundle

from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.cli.processes import Children
from mapmerge_ros.fusion import FusionConfig, fuse
from mapmerge_ros.geometry import Similarity, align
from mapmerge_ros.io import write_submaps
from mapmerge_ros.submap import Source, SubMap

S = 1_000_000_000


def submap_of(scene: int, robot: int, revision: int, stamp_ns: int, noise: int = 0) -> SubMap:
    """What a robot sees of a scene, in a frame of its own."""
    bundle = random_bundle(scene, points=40, noise_px=0.0)
    rng = np.random.default_rng([scene, robot, noise])
    noisy = bundle.observations_px + 0.3 * rng.normal(size=bundle.observations_px.shape)
    own = replace(bundle, observations_px=noisy).transformed(Similarity.exp(rng.normal(size=7)))
    name = MapName(f'd{robot}/0', f'd{robot}', revision, stamp_ns, id_space='site')
    return compress(own, name, own.point_ids[:20])


def held(observer: Observer) -> dict[str, int]:
    alignments = observer.heard.alignments
    return {x.map_id: x.revision for x in alignments.alignments} if alignments else {}


def assert_same_map(observer: Observer, submaps: list[SubMap]) -> None:
    """The shape of the map that these make offline, whichever of them holds the frame."""
    expected, found = fuse(submaps, FusionConfig()).global_map, observer.heard.global_map
    assert expected is not None
    assert found is not None
    assert found.sources == expected.sources
    np.testing.assert_array_equal(found.landmark_ids, expected.landmark_ids)
    S_found_expected = align(found.points, expected.points).S_target_source
    moved = S_found_expected.apply(expected.points)
    np.testing.assert_allclose(moved, found.points, rtol=1e-5, atol=1e-5)


def test_robots_come_leave_and_begin_again(
    children: Children, observer: Observer, tmp_path: Path
) -> None:
    values = {'merge_period': 0.2, 'robot_timeout': 0.5, 'ask': False}
    children.start('fusion', FUSION, values)
    robots = [submap_of(0, k, revision=5, stamp_ns=k * S) for k in range(8)]
    site = recorded(tmp_path / 'site.mcap', robots)
    processes = {k: play(children, site, k) for k in np.random.default_rng(0).permutation(8)}
    spin_until([observer], lambda: observer.merged == 8, 'all eight')

    for k in (2, 6):
        processes[k].send_signal(signal.SIGKILL)
    for k in (3, 4):
        processes[k].terminate()
        assert processes[k].wait(10) == 0
    # One plays its recording again: nothing in there is newer than what is known.
    old = replace(robots[3], revision=4, sources=(Source('d3/0', 4),), stamp_ns=0)
    # The other counts anew, and has seen more since.
    anew = submap_of(0, 4, revision=1, stamp_ns=100 * S, noise=1)
    again = recorded(tmp_path / 'again.mcap', [old, anew])
    lives = [play(children, again, k, 'again') for k in (3, 4)]
    spin_until(
        [observer],
        lambda: held(observer).get('d4/0') == 1 and observer.merged == 8,
        'the map of the new life',
    )
    spin_until(
        [observer],
        lambda: (
            observer.node_values.get('robots_stale') == '2'
            and observer.node_values.get('messages_ignored') == '1'
        ),
        'two of them are stale, and the old revision is ignored',
    )
    level, text, _ = observer.diagnostics['/fusion_node: robot d2']
    assert (level, text.startswith('left ')) == (b'\3', True)
    assert observer.diagnostics['/fusion_node: robot d1'][0] == b'\0'
    assert held(observer) == {f'd{k}/0': 1 if k == 4 else 5 for k in range(8)}
    assert_same_map(observer, [*robots[:4], anew, *robots[5:]])
    assert 'd4/0 begins again with revision 1' in children.log('fusion').read_text()
    assert all(process.poll() is None for process in lives)


def recorded(path: Path, submaps: list[SubMap]) -> Path:
    """Recording of sub-maps, each on the topic of its robot."""
    write_submaps(path, [(f'/{x.robot_id}/submap', x.stamp_ns, x) for x in submaps])
    return path


def play(children: Children, recording: Path, robot: int, life: str = 'first') -> Any:
    """A robot of a recording, as a process."""
    values = {'recording': str(recording), 'robot_id': f'd{robot}', 'rate': 0}
    return children.start(f'd{robot}_{life}', ROBOT, values)


def test_two_fleets_on_one_network_do_not_hear_each_other(
    children: Children, observer: Observer
) -> None:
    fleets = {'red': 0, 'blue': 1}
    maps = {name: [submap_of(scene, k, 1, k) for k in range(3)] for name, scene in fleets.items()}
    others = {'red': observer, 'blue': Observer('/blue/fusion_node', 'blue_observer')}
    others['red'] = Observer('/red/fusion_node', 'red_observer')
    for name in fleets:
        children.start(name, FUSION, {'merge_period': 0.2}, {'__ns': f'/{name}'})
    for name, submaps in maps.items():
        for submap in submaps:
            others[name].send(f'/{name}/{submap.robot_id}/submap', submap)
    nodes = list(others.values())
    spin_until(nodes, lambda: all(x.merged == 3 for x in nodes), 'both maps')
    spin_until(
        nodes,
        lambda: all(x.node_values.get('messages_received') == '3' for x in nodes),
        'the counters',
    )
    for name, submaps in maps.items():
        assert_same_map(others[name], submaps)
        assert others[name].heard.global_map.map_id == f'{name}/fusion_node/global'
        others[name].destroy_node()


def test_the_global_frame_stays_when_a_map_is_added(
    children: Children, observer: Observer
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.1, 'ask': False})
    robots = [submap_of(0, k, revision=1, stamp_ns=k * S) for k in range(5)]
    for submap in robots[1:4]:
        observer.send(f'/{submap.robot_id}/submap', submap)
    spin_until([observer], lambda: observer.merged == 3, 'three')
    before = observer.heard.global_map
    # The last one is older than all the others: alone it would hold the frame.
    for count, submap in ((4, robots[4]), (5, robots[0])):
        observer.send(f'/{submap.robot_id}/submap', submap)
        spin_until([observer], lambda count=count: observer.merged == count, f'{count} maps')
    after = observer.heard.global_map
    assert before is not None
    assert after is not None
    _, old, new = np.intersect1d(before.landmark_ids, after.landmark_ids, return_indices=True)
    assert len(old) >= 20
    S_after_before = align(after.points[new], before.points[old]).S_target_source
    moved = S_after_before.apply(before.points[old]) - before.points[old]
    std = np.sqrt(np.median(after.covariances[new][:, [0, 3, 5]].sum(axis=1)))
    assert np.linalg.norm(moved, axis=1).max() < std
