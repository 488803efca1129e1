# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Robots announce, the fusion node asks, the robots compress: real nodes on real topics."""

from __future__ import annotations

import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_processes import (
    FUSION,
    PATIENCE_S,
    REMEDY,
    Observer,
    SubMapMessage,
    spin_for,
    spin_until,
)

from mapmerge_ros.bundle import compress
from mapmerge_ros.cli.main import main
from mapmerge_ros.cli.processes import Children
from mapmerge_ros.fusion import FusionConfig, fuse
from mapmerge_ros.geometry import align
from mapmerge_ros.io import NamedBundle, decode_submap, encode_bundle, encode_request
from mapmerge_ros.nodes.quality import LATCHED_PROFILE, REQUESTS_PROFILE
from mapmerge_ros.simulation import Fleet, FleetConfig, simulate_fleet
from mapmerge_ros.submap import Request, SubMap

pytest.importorskip('pycolmap', reason='pycolmap is missing to simulate bundles')
FusionStatus = pytest.importorskip('mapmerge_msgs.msg', reason=REMEDY).FusionStatus
BundleMessage = pytest.importorskip('mapmerge_msgs.msg', reason=REMEDY).Bundle
LandmarkRequest = pytest.importorskip('mapmerge_msgs.msg', reason=REMEDY).LandmarkRequest

ROBOT = 'mapmerge_ros.nodes.compressor_node'
DRONES, LANDMARKS, SEED = 3, 120, 3


@pytest.fixture(scope='module')
def fleet() -> Fleet:
    return simulate_fleet(FleetConfig(drones=DRONES, landmarks=LANDMARKS), seed=SEED)


@pytest.fixture(scope='module')
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with the bundle of every drone."""
    path = tmp_path_factory.mktemp('bundles') / 'bundles.mcap'
    scene = ['--drones', str(DRONES), '--landmarks', str(LANDMARKS), '--seed', str(SEED)]
    assert main(['simulate', str(path), *scene, '--bundles']) == 0
    return path


def start_robot(children: Children, bundles: Path, robot_id: str) -> Any:
    values = {'bundle': str(bundles), 'robot_id': robot_id}
    return children.start(robot_id, ROBOT, values, {'submap': f'/{robot_id}/submap'})


def wait_for_log(observer: Observer, children: Children, name: str, words: str) -> None:
    log = children.log(name)
    spin_until([observer], lambda: words in log.read_text(), f'{name}: {words}')


def revisions(observer: Observer) -> dict[str, int]:
    return {x.map_id: x.revision for x in observer.heard.alignments.alignments}


def sent(observer: Observer) -> int:
    return int(observer.node_values['requests_sent'])


def test_robots_announce_then_compress_what_a_late_node_asks_for(
    children: Children, observer: Observer, bundles: Path, fleet: Fleet
) -> None:
    robots = [name.robot_id for name in fleet.names]
    processes = [start_robot(children, bundles, robot_id) for robot_id in robots]
    for robot_id in robots:
        wait_for_log(observer, children, robot_id, 'announced')
    children.start('fusion', FUSION, {'merge_period': 0.3, 'request_landmarks': 40})
    spin_until([observer], lambda: observer.merged == DRONES, 'all merged')
    spin_for([observer], 2.5)
    asked = sent(observer)
    # One that was asked before the node had heard of all may be asked for something else.
    assert DRONES <= asked <= 2 * DRONES
    spin_for([observer], 2.5)
    assert sent(observer) == asked, 'nobody is asked again'
    assert observer.node_values['requests_unanswered'] == '0'
    assert observer.heard.status.accepted
    assert_map_is_true(observer, fleet)

    before = revisions(observer)
    processes[0].send_signal(signal.SIGINT)
    assert processes[0].wait(10) == 0
    again = start_robot(children, bundles, robots[0])
    spin_until(
        [observer],
        lambda: (
            revisions(observer)[fleet.names[0].map_id] > before[fleet.names[0].map_id]
            and observer.merged == DRONES
        ),
        'a robot that comes back under its name is asked, and merged again',
    )
    assert_map_is_true(observer, fleet)
    spin_for([observer], 2.5)
    assert sent(observer) == asked + 1, 'the others have what it needs'
    assert again.poll() is None
    assert children.ended() == ''
    assert set(children.stop(PATIENCE_S).values()) == {0}


def assert_map_is_true(observer: Observer, fleet: Fleet) -> None:
    """As near to the truth as the merge of the very same landmarks without any topics."""
    found = observer.heard.global_map
    assert found is not None
    ids = found.compressed_ids
    direct = fuse(
        [
            compress(bundle, name, ids[np.isin(ids, bundle.point_ids)])
            for bundle, name in zip(fleet.bundles, fleet.names, strict=True)
        ],
        FusionConfig(),
    ).global_map
    assert direct is not None
    for submap in (found, direct):
        truth = fleet.truth.points_world(submap.compressed_ids)
        S_world_global = align(truth, submap.compressed_points).S_target_source
        errors = np.linalg.norm(S_world_global.apply(submap.compressed_points) - truth, axis=1)
        assert np.median(errors) < 0.1


def test_a_slam_that_keeps_sending_stays_in_the_global_map(
    children: Children, observer: Observer, fleet: Fleet
) -> None:
    """Every bundle used to put its robot out of the merge until it was asked again."""
    senders = {}
    for name in fleet.names:
        topics = {key: f'/{name.robot_id}/{key}' for key in ('submap', 'bundle')}
        children.start(name.robot_id, ROBOT, {}, topics)
        senders[name.map_id] = observer.create_publisher(
            BundleMessage, topics['bundle'], LATCHED_PROFILE
        )
    children.start('fusion', FUSION, {'merge_period': 0.3, 'request_landmarks': 40})

    def send(k: int, revision: int) -> None:
        name = replace(fleet.names[k], revision=revision)
        stamps = (0,) * len(fleet.bundles[k].keyframe_ids)
        raw = encode_bundle(NamedBundle(name, fleet.bundles[k], stamps))
        senders[name.map_id].publish(raw)

    for k in range(DRONES):
        send(k, 1)
    spin_until([observer], lambda: observer.merged == DRONES, 'all merged')
    spin_for([observer], 1.0)
    merged: list[int] = []
    observer.create_subscription(
        FusionStatus,
        '/fusion_node/status',
        lambda message: merged.append(message.merged),
        LATCHED_PROFILE,
    )
    for revision in range(2, 10):
        before = revisions(observer)[fleet.names[0].map_id]
        send(0, revision)
        spin_for([observer], 0.4)
    spin_until(
        [observer],
        lambda: revisions(observer)[fleet.names[0].map_id] > before,
        'one of the last bundles is merged',
    )
    assert set(merged) == {DRONES}
    assert len(merged) > 2
    assert_map_is_true(observer, fleet)
    assert children.ended() == ''


def test_bad_requests_disturb_nothing(
    children: Children, observer: Observer, bundles: Path, fleet: Fleet
) -> None:
    name, bundle = fleet.names[0], fleet.bundles[0]
    start_robot(children, bundles, name.robot_id)
    wait_for_log(observer, children, name.robot_id, 'announced')
    requests = observer.create_publisher(
        LandmarkRequest, '/fusion_node/requests', REQUESTS_PROFILE
    )
    spin_until([observer], requests.get_subscription_count, 'the robot listens')
    announced = submaps_of(observer, name.robot_id)
    spin_until([observer], lambda: announced, 'the announcement')
    revision = announced[0].revision

    def ask(ids: Any, **changes: Any) -> None:
        values = {'map_id': name.map_id, 'robot_id': name.robot_id, 'revision': revision}
        request = Request(**{**values, 'landmark_ids': np.asarray(ids, np.uint64), **changes})
        requests.publish(encode_request(request, 0))

    good = bundle.point_ids[:20]
    requests.publish(LandmarkRequest(map_id=name.map_id, robot_id=name.robot_id))
    requests.publish(b'\0\1\0\0nonsense')
    ask(good, map_id='nobody/0001')
    ask(good, robot_id='nobody')
    ask(good, revision=revision - 1)
    ask([2**60, 2**60 + 1, 2**60 + 2, 2**60 + 3])
    ask(good[:2])
    wait_for_log(observer, children, name.robot_id, 'too few')
    spin_for([observer], 0.5)
    assert [submap.compressed_count for submap in announced] == [0]

    ask([*good, 2**60])
    spin_until([observer], lambda: len(announced) == 2, 'the good one is answered')
    np.testing.assert_array_equal(announced[1].compressed_ids, good)
    assert announced[1].revision == revision + 1
    ask([*good, 2**60])
    spin_until([observer], lambda: len(announced) == 3, 'and repeated as it was')
    assert announced[2].revision == revision + 1
    log = children.log(name.robot_id).read_text()
    for words in ('nothing is asked for', "'nobody'", 'unknown landmarks', 'bytes are not'):
        assert words in log, log
    assert children.ended() == ''


def test_a_robot_whose_clock_was_set_back_learns_how_far_it_was(
    children: Children, observer: Observer, bundles: Path, fleet: Fleet
) -> None:
    """The fusion side would take nothing older; its last request is still there."""
    name, far = fleet.names[0], int(time.time()) + 1_000_000
    requests = observer.create_publisher(
        LandmarkRequest, '/fusion_node/requests', REQUESTS_PROFILE
    )
    asked = Request(name.map_id, name.robot_id, far, fleet.bundles[0].point_ids[:20])
    requests.publish(encode_request(asked, 0))
    heard = submaps_of(observer, name.robot_id)
    start_robot(children, bundles, name.robot_id)
    spin_until([observer], lambda: heard and heard[-1].revision > far + 1, 'a later revision')
    assert heard[-1].compressed_count == 0


def submaps_of(observer: Observer, robot_id: str) -> list[SubMap]:
    """Sub-maps of a robot, filled while the observer is spun."""
    heard: list[SubMap] = []
    observer.create_subscription(
        SubMapMessage,
        f'/{robot_id}/submap',
        lambda raw: heard.append(decode_submap(raw)),
        LATCHED_PROFILE,
        raw=True,
    )
    return heard


def test_a_robot_without_a_bundle_says_so(children: Children, observer: Observer) -> None:
    process = children.start('robot', ROBOT, {'bundle': '/nowhere/model.mcap'})
    spin_until([observer], lambda: process.poll() is not None, 'it ends')
    assert process.returncode == 1
    assert '/nowhere/model.mcap' in children.log('robot').read_text()
    assert 'Traceback' not in children.log('robot').read_text()
