# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bundles in on a topic, corrected paths out: the robots agree with the bundle of all of them."""

from __future__ import annotations

from dataclasses import replace
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
from scenes import random_bundle, with_a_turn_on_the_spot

from mapmerge_ros.bundle import Bundle, MapName
from mapmerge_ros.cli.processes import Children
from mapmerge_ros.fusion.refine import Robot, refine
from mapmerge_ros.geometry import Similarity, align
from mapmerge_ros.io import (
    NamedBundle,
    decode_bundle,
    decode_submap,
    encode_bundle,
    encode_request,
)
from mapmerge_ros.nodes.compressor_node import CompressorNode
from mapmerge_ros.nodes.outbox import Outbox
from mapmerge_ros.nodes.own_maps import OwnMaps
from mapmerge_ros.nodes.quality import LATCHED_PROFILE, REQUESTS_PROFILE
from mapmerge_ros.submap import Request, SubMap

BundleMessage = pytest.importorskip('mapmerge_msgs.msg', reason=REMEDY).Bundle
RequestMessage = pytest.importorskip('mapmerge_msgs.msg', reason=REMEDY).LandmarkRequest
PathMessage = pytest.importorskip('nav_msgs.msg', reason=REMEDY).Path
PointCloud2 = pytest.importorskip('sensor_msgs.msg', reason=REMEDY).PointCloud2

COMPRESSOR = 'mapmerge_ros.nodes.compressor_node'
ROBOTS, S = 3, 1_000_000_000
FAR = 4_000_000_000
"""A revision beyond every clock"""


def bundle_of(robot: int, revision: int = 1) -> NamedBundle:
    """What a robot sees of one scene, in a frame of its own, as it comes off the wire."""
    bundle = random_bundle(0, points=40, noise_px=0.0)
    rng = np.random.default_rng(robot)
    noisy = bundle.observations_px + 0.5 * rng.normal(size=bundle.observations_px.shape)
    own = replace(bundle, observations_px=noisy).transformed(Similarity.exp(rng.normal(size=7)))
    name = MapName(f'd{robot}/0', f'd{robot}', revision, robot * S, id_space='site')
    stamps = tuple((10 * robot + k) * S for k in range(len(own.keyframe_ids)))
    return decode_bundle(encode_bundle(NamedBundle(name, own, stamps)))


class Heard:
    """The newest of what the robots publish."""

    def __init__(self, observer: Observer, robots: int) -> None:
        self.submaps: dict[str, SubMap] = {}
        self.paths: dict[str, Any] = {}
        self.clouds: dict[str, Any] = {}
        self.senders: dict[str, Any] = {}
        for k in range(robots):
            self._listen(observer, f'd{k}')

    def _listen(self, observer: Observer, robot: str) -> None:
        subscribe, profile = observer.create_subscription, LATCHED_PROFILE

        def take_submap(raw: bytes) -> None:
            self.submaps[robot] = decode_submap(raw)

        def take_path(message: Any) -> None:
            self.paths[robot] = message

        def take_cloud(message: Any) -> None:
            self.clouds[robot] = message

        subscribe(SubMapMessage, f'/{robot}/submap', take_submap, profile, raw=True)
        subscribe(PathMessage, f'/{robot}/path', take_path, profile)
        subscribe(PointCloud2, f'/{robot}/landmarks', take_cloud, profile)
        self.senders[robot] = observer.create_publisher(BundleMessage, f'/{robot}/bundle', profile)

    def positions(self, robot: str) -> Any:
        poses = self.paths[robot].poses
        return np.array([[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in poses])


def centres_of(bundle: Bundle) -> Any:
    R, t = bundle.rotations_camera_map, bundle.translations_camera_map
    return -np.einsum('mji,mj->mi', R, t)


def test_paths_of_the_robots_are_those_of_the_full_bundle(
    children: Children, observer: Observer
) -> None:
    heard, bundles = Heard(observer, ROBOTS), [bundle_of(k) for k in range(ROBOTS)]
    for k, named in enumerate(bundles):
        values = {'robot_id': f'd{k}', 'relinearise_rounds': 3}
        children.start(f'd{k}', COMPRESSOR, values, {'__ns': f'/d{k}'})
        heard.senders[f'd{k}'].publish(encode_bundle(named))
    children.start('fusion', FUSION, {'merge_period': 0.3, 'request_landmarks': 20})
    spin_until(
        [observer],
        lambda: len(heard.paths) == len(heard.clouds) == ROBOTS,
        'path and landmarks of every robot',
    )
    assert all(submap.compressed_count == 20 for submap in heard.submaps.values())
    full = joint(heard, bundles)
    alone = [
        np.linalg.norm(align(own, joined).S_target_source.apply(joined) - own, axis=1).max()
        for own, joined in ((centres_of(x.bundle), full[x.name.robot_id]) for x in bundles)
    ]
    assert min(alone) > 1e-3, 'there is something to correct'
    spin_until(
        [observer],
        lambda: max(distances(heard, full)) < 1e-5,
        'paths within 1e-5 of the full bundle',
    )
    for k, named in enumerate(bundles):
        path = heard.paths[f'd{k}']
        assert path.header.frame_id == 'global'
        stamps = [pose.header.stamp.sec * S for pose in path.poses]
        assert stamps == list(named.keyframe_stamps_ns)
        assert heard.clouds[f'd{k}'].width == len(named.bundle.point_ids)
    assert children.ended() == ''
    assert set(children.stop(PATIENCE_S).values()) == {0}


def joint(heard: Heard, bundles: list[NamedBundle]) -> dict[str, Any]:
    """Camera centres of each robot in the bundle of all, each in its own frame."""
    robots = [
        Robot(named.name, named.bundle, heard.submaps[named.name.robot_id].compressed_ids)
        for named in bundles
    ]
    refined, rounds = refine(robots, 20)
    assert rounds[-1].step_ratio < 1e-6
    return {robot.name.robot_id: centres_of(robot.bundle) for robot in refined}


def distances(heard: Heard, full: dict[str, Any]) -> list[float]:
    """Largest distance of a camera centre from where the full bundle has it, per robot."""
    found = []
    for robot, expected in full.items():
        positions = heard.positions(robot)
        S_global_map = align(positions, expected).S_target_source
        off = np.linalg.norm(S_global_map.apply(expected) - positions, axis=1)
        found.append(float(off.max()))
    return found


def test_a_newer_bundle_takes_the_place_of_the_older(
    children: Children, observer: Observer
) -> None:
    heard = Heard(observer, 1)
    children.start('d0', COMPRESSOR, {}, {'__ns': '/d0'})
    send = heard.senders['d0'].publish
    send(encode_bundle(bundle_of(0)))
    spin_until([observer], lambda: heard.submaps, 'the announcement')
    first = heard.submaps['d0']
    send(b'\0\1\0\0nonsense')
    send(encode_bundle(bundle_of(0)))
    send(encode_bundle(bundle_of(0, revision=2)))
    spin_until(
        [observer],
        lambda: heard.submaps['d0'].revision > first.revision,
        'the announcement of the newer one',
    )
    assert heard.submaps['d0'].compressed_count == 0
    log = children.log('d0')
    spin_until([observer], lambda: 'refused' in log.read_text(), 'nonsense is refused')
    spin_until([observer], lambda: log.read_text().count('announced') == 2, 'two of them')
    spin_for([observer], 0.3)
    assert log.read_text().count('announced') == 2, 'what came twice is not newer'


def test_of_many_bundles_in_a_row_the_newest_counts(
    children: Children, observer: Observer
) -> None:
    """A SLAM that is faster than the robot: what waits is replaced, and a request is answered."""
    heard, count, first = Heard(observer, 1), 20, large_bundle()
    children.start('d0', COMPRESSOR, {}, {'__ns': '/d0'})
    requests = observer.create_publisher(RequestMessage, '/fusion_node/requests', REQUESTS_PROFILE)
    send = heard.senders['d0']
    spin_until([observer], send.get_subscription_count, 'the robot listens')
    spin_until([observer], requests.get_subscription_count, 'also to requests')
    send.publish(encode_bundle(first))
    spin_until([observer], lambda: heard.submaps, 'the first')
    ids = first.bundle.point_ids[:10]
    for k in range(1, count + 1):
        later = replace(first, name=replace(first.name, revision=FAR + k))
        send.publish(encode_bundle(later))
        if k == count // 2:
            revision = heard.submaps['d0'].revision
            requests.publish(encode_request(Request('d0/0', 'd0', revision, ids), 0))
        spin_for([observer], 0.05)
    spin_until(
        [observer],
        lambda: (
            heard.submaps['d0'].revision >= FAR + count and heard.submaps['d0'].compressed_count
        ),
        'the last one, compressed',
    )
    np.testing.assert_array_equal(heard.submaps['d0'].compressed_ids, ids)
    log = children.log('d0').read_text()
    assert log.count('announced') + log.count('sent') <= count // 2, log


def large_bundle() -> NamedBundle:
    """One that takes much longer to announce than the test leaves between two of them."""
    bundle = random_bundle(0, points=4000, keyframes=40)
    name = MapName('d0/0', 'd0', FAR, id_space='site')
    return NamedBundle(name, bundle, (0,) * len(bundle.keyframe_ids))


def test_points_without_parallax_are_told_once(children: Children, observer: Observer) -> None:
    heard, named = Heard(observer, 1), bundle_of(0)
    turned = replace(named, bundle=with_a_turn_on_the_spot(named.bundle))
    stamps = (*named.keyframe_stamps_ns, 0)
    children.start('d0', COMPRESSOR, {}, {'__ns': '/d0'})
    for revision in (1, 2, 3):
        name = replace(named.name, revision=revision)
        heard.senders['d0'].publish(
            encode_bundle(replace(turned, name=name, keyframe_stamps_ns=stamps))
        )
        spin_until(
            [observer],
            lambda count=revision: children.log('d0').read_text().count('announced') == count,
            'an announcement',
        )
    assert children.log('d0').read_text().count('d0/0: 1 landmark left out') == 1
    assert len(heard.submaps['d0'].landmark_ids) == len(named.bundle.point_ids)


def test_a_failure_names_the_map(
    children: Children,
    observer: Observer,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    def fail(*_: Any) -> None:
        raise ArithmeticError('a bug')

    monkeypatch.setattr(OwnMaps, 'prepare', fail)
    node, heard, shown = CompressorNode(), Heard(observer, 1), []
    sender = observer.create_publisher(BundleMessage, 'bundle', LATCHED_PROFILE)
    sender.publish(encode_bundle(bundle_of(0)))

    def log() -> str:
        shown.append(capfd.readouterr().err)
        return ''.join(shown)

    try:
        spin_until([observer, node], lambda: 'a bug' in log(), 'the failure')
    finally:
        node.close()
        node.destroy_node()
    assert 'bundle of d0/0 failed: ArithmeticError: a bug' in log()
    assert not heard.submaps


def test_an_outbox_keeps_its_budget_and_sends_the_newest() -> None:
    sent: list[tuple[str, bytes]] = []
    outbox = Outbox(100.0, lambda map_id, raw: sent.append((map_id, raw)))
    outbox.put('a', b'x' * 150, 0.0)
    outbox.put('a', b'old', 0.1)
    outbox.put('b', b'y' * 50, 0.2)
    outbox.put('a', b'new', 0.3)
    assert (len(sent), outbox.waiting) == (1, 2)
    outbox.flush(1.4)
    assert len(sent) == 1
    outbox.flush(1.5)
    assert sent[1:] == [('a', b'new')]
    outbox.flush(1.6)
    assert sent[2:] == [('b', b'y' * 50)]
    free = Outbox(0.0, lambda map_id, raw: sent.append((map_id, raw)))
    for _ in range(5):
        free.put('c', b'z' * 1000, 0.0)
    assert len(sent) == 8
