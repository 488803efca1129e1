# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fusion node on real topics: what the replay finds, whoever comes when, whatever is sent."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_processes import (
    FUSION,
    ROBOT,
    Observer,
    load,
    make_recording,
    observing,
    rclpy,
    spin_for,
    spin_until,
)
from std_srvs.srv import Trigger

from mapmerge_ros.cli.processes import Children, free_domain
from mapmerge_ros.fusion import Fusion, FusionConfig, Snapshot, fuse
from mapmerge_ros.geometry import align
from mapmerge_ros.io import (
    MAX_MESSAGE_BYTES,
    create,
    decode_submap,
    encode_submap,
    submap_to_message,
)
from mapmerge_ros.io.codec import serialise
from mapmerge_ros.nodes import merge_loop, parameters
from mapmerge_ros.nodes.fusion_node import FusionNode
from mapmerge_ros.nodes.outgoing import covariance_of_parts
from mapmerge_ros.nodes.worker import Worker
from mapmerge_ros.submap import Source, SubMap


@pytest.fixture(scope='module')
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_recording(tmp_path_factory.mktemp('recording'))


@pytest.fixture(scope='module')
def submaps(recording: Path) -> tuple[SubMap, ...]:
    return load(recording)


@pytest.fixture
def children(tmp_path: Path) -> Iterator[Children]:
    with Children(free_domain(), tmp_path / 'logs') as started:
        yield started


@pytest.fixture
def observer(children: Children) -> Iterator[Observer]:
    with observing(children.domain) as node:
        yield node


@pytest.fixture
def nodes(observer: Observer) -> Iterator[list[Any]]:
    """A fusion node in this process that merges only when asked, and its observer."""
    node = fusion_node(merge_period=3600.0)
    yield [node, observer]
    node.close()
    node.destroy_node()


def fusion_node(**values: Any) -> FusionNode:
    overrides = [rclpy.Parameter(name, value=value) for name, value in values.items()]
    return FusionNode(parameter_overrides=overrides)


def submap_topic(submap: SubMap) -> str:
    return f'/{submap.robot_id}/submap'


def leaves(*submaps: SubMap) -> tuple[Source, ...]:
    return tuple(sorted({source for submap in submaps for source in submap.sources}))


def assert_equal_to_replay(observer: Observer, expected: Fusion) -> None:
    """Same engine, same messages: equal up to the rounding of other BLAS threads."""
    found, replayed, status = observer.heard.global_map, expected.global_map, observer.heard.status
    assert found is not None
    assert replayed is not None
    sent = decode_submap(encode_submap(replayed))
    np.testing.assert_array_equal(found.landmark_ids, sent.landmark_ids)
    np.testing.assert_allclose(found.points, sent.points, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.packed_r, sent.packed_r, rtol=1e-5, atol=1e-3)
    assert found.a == pytest.approx(sent.a, rel=1e-9)
    for name in ('sources', 'gauge', 'residual_count', 'dof', 'stamp_ns', 'compressed_count'):
        assert getattr(found, name) == getattr(sent, name), name

    verdict = expected.verdict
    assert (status.dof, status.accepted, status.reason) == (
        verdict.dof,
        verdict.accepted,
        verdict.reason,
    )
    for name in ('a_tilde', 'sigma', 'variance_factor', 'p_value'):
        assert getattr(status, name) == pytest.approx(getattr(verdict, name), rel=1e-9), name
    assert (status.sub_maps, status.merged) == (len(expected.alignments),) * 2
    assert status.landmarks == len(expected.components[0].landmarks.ids)

    alignments = observer.heard.alignments.alignments
    for sent_item, item in zip(alignments, expected.alignments, strict=True):
        S_global_map = item.S_global_map
        assert (sent_item.map_id, sent_item.state) == (item.submap.map_id, int(item.state))
        assert sent_item.scale == pytest.approx(S_global_map.scale, rel=1e-9)
        t = sent_item.translation
        np.testing.assert_allclose([t.x, t.y, t.z], S_global_map.translation, atol=1e-9)
        np.testing.assert_allclose(
            sent_item.covariance.reshape(7, 7),
            covariance_of_parts(S_global_map, item.covariance),
            rtol=1e-5,
            atol=1e-12,
        )


def test_late_node_and_late_listener_get_what_the_replay_finds(
    children: Children, observer: Observer, recording: Path, submaps: tuple[SubMap, ...]
) -> None:
    for robot_id in sorted({submap.robot_id for submap in submaps}):
        values = {'recording': str(recording), 'robot_id': robot_id, 'rate': 0}
        children.start(robot_id, ROBOT, values)
    spin_until(
        [observer],
        lambda: all('sent' in children.log(x.robot_id).read_text() for x in submaps),
        'the robots have sent',
    )
    children.start('fusion', FUSION, {'merge_period': 3600})
    spin_until(
        [observer],
        lambda: observer.node_values.get('sub_maps') == str(len(submaps)),
        'the node has what was sent before it was there',
    )
    response = observer.call(merge_now_service(), 'merge_now')
    spin_until([observer], lambda: observer.heard.is_complete, 'the result')
    expected = fuse(submaps, FusionConfig(map_id='fusion_node/global'))
    assert response.result == 0
    assert response.status.a_tilde == observer.heard.status.a_tilde
    assert_equal_to_replay(observer, expected)

    late = Observer(name='late')
    spin_until([late], lambda: late.heard.is_complete, 'the latest map for a late listener')
    assert encode_submap(late.heard.global_map) == encode_submap(observer.heard.global_map)
    late.destroy_node()

    assert children.ended() == ''
    codes = children.stop()
    assert set(codes.values()) == {0}, codes
    for name in codes:
        assert 'Traceback' not in children.log(name).read_text()


def merge_now_service() -> type[Any]:
    from mapmerge_msgs.srv import MergeNow

    return MergeNow


def broken(submap: SubMap, map_id: str, **changes: Any) -> bytes:
    """Message of a sub-map with fields that no sub-map could have."""
    message = submap_to_message(replace(submap, map_id=map_id), create)
    for name, value in changes.items():
        setattr(message, name, value)
    return serialise(message)


def test_what_is_wrong_is_refused_and_disturbs_nothing(
    children: Children, observer: Observer, submaps: tuple[SubMap, ...]
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.2})
    first, second, *_ = submaps
    points = np.array(first.points.ravel())
    points[4] = np.nan
    wrong = {
        'points': broken(first, 'bad/points', points=points[:-1]),
        'points: value 4': broken(first, 'bad/nan', points=points),
        'appears twice': broken(
            first, 'bad/ids', landmark_ids=np.full(len(first.landmark_ids), 5, np.uint64)
        ),
        'gauge': broken(first, 'bad/gauge', gauge=5),
        'bytes are not': encode_submap(first)[:100],
    }
    for submap in (first, second):
        observer.send('/robot/submap', submap)
    for raw in (*wrong.values(), *wrong.values()):
        observer.send('/robot/submap', raw)
    observer.send('/robot/submap', first)
    spin_until(
        [observer],
        lambda: (
            observer.node_values.get('messages_refused') == str(2 * len(wrong))
            and observer.node_values.get('messages_ignored') == '1'
        ),
        'every wrong message is counted, and the old revision ignored',
    )
    level, message, values = observer.diagnostics['/fusion_node: fusion']
    assert level == b'\1'
    assert 'bytes are not' in values['last_refusal']
    assert 'refused' in message
    log = children.log('fusion').read_text()
    for part in wrong:
        lines = [line for line in log.splitlines() if 'refused:' in line and part in line]
        assert len(lines) == 1 + (part == 'points'), (part, log)
    heard = observer.heard
    spin_until([observer], lambda: heard.is_complete and heard.status.merged == 2, 'both merged')
    assert {x.map_id for x in heard.alignments.alignments} == {first.map_id, second.map_id}
    assert children.ended() == ''


def test_fusion_nodes_stack(
    children: Children, observer: Observer, submaps: tuple[SubMap, ...]
) -> None:
    near, far = submaps[:2], submaps[2:]
    topics = '|'.join(map(submap_topic, near))
    children.start(
        'site',
        FUSION,
        {'merge_period': 0.2, 'discovery_pattern': topics},
        {'__ns': '/site'},
    )
    topics = '|'.join(['/site/.*/global_map', *map(submap_topic, far)])
    children.start('fusion', FUSION, {'merge_period': 0.2, 'discovery_pattern': topics})
    for submap in submaps:
        observer.send(submap_topic(submap), submap)
    spin_until(
        [observer],
        lambda: (
            observer.heard.is_complete
            and observer.heard.status.merged == 1 + len(far)
            and observer.heard.global_map.sources == leaves(*submaps)
        ),
        'a map of a map and of sub-maps',
    )
    names = {item.map_id for item in observer.heard.alignments.alignments}
    assert names == {'site/fusion_node/global', *(submap.map_id for submap in far)}
    expected = fuse(submaps).global_map
    assert expected is not None
    assert observer.heard.global_map is not None
    _, rows, others = np.intersect1d(
        expected.compressed_ids, observer.heard.global_map.compressed_ids, return_indices=True
    )
    assert len(rows) > 20
    target, source = expected.points[rows], observer.heard.global_map.points[others]
    off = align(target, source).S_target_source.apply(source) - target
    extent = np.linalg.norm(target - target.mean(axis=0), axis=1).mean()
    assert np.linalg.norm(off, axis=1).max() < 1e-3 * extent
    assert children.ended() == ''


@pytest.mark.parametrize('name', ['fusion', 'robot'])
def test_a_wrong_parameter_is_one_line(
    name: str, children: Children, observer: Observer, recording: Path
) -> None:
    if name == 'fusion':
        process = children.start(name, FUSION, {'merge_period': -1.0})
    else:
        process = children.start(name, ROBOT, {'recording': str(recording), 'robot_id': 'x'})
    assert process.wait(30) == 1
    text = children.log(name).read_text().strip()
    assert len(text.splitlines()) == 1, text
    assert ('merge_period' if name == 'fusion' else 'robot_id') in text


def test_sigterm_ends_a_node_like_sigint(children: Children, observer: Observer) -> None:
    process = children.start('fusion', FUSION, {})
    spin_until([observer], lambda: observer.diagnostics, 'the node is there')
    process.send_signal(signal.SIGTERM)
    assert process.wait(5) == 0
    assert 'Traceback' not in children.log('fusion').read_text()


class Gate:
    """A merge that waits until it is let go on."""

    def __init__(self) -> None:
        self.entered = threading.Event()
        self.opened = threading.Event()
        self.calls = 0

    def __call__(self, snapshot: Snapshot, config: FusionConfig, memory: Any) -> Fusion:
        self.calls += 1
        self.entered.set()
        assert self.opened.wait(30)
        return fuse(snapshot, config, memory)


def test_messages_are_received_during_a_merge(
    observer: Observer, submaps: tuple[SubMap, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = Gate()
    monkeypatch.setattr(merge_loop, 'fuse', gate)
    node = fusion_node(merge_period=0.05)
    nodes = [node, observer]
    observer.send('/submaps', submaps[0])
    spin_until(nodes, gate.entered.is_set, 'the merge begins')
    for submap in submaps[1:]:
        observer.send('/submaps', submap)
    spin_until(
        nodes, lambda: node.session.ledger.received == len(submaps), 'messages during the merge'
    )
    spin_for(nodes, 0.3)
    assert gate.calls == 1
    assert node.session.fusion is None
    gate.opened.set()
    spin_until(
        nodes,
        lambda: observer.heard.is_complete and observer.heard.status.merged == len(submaps),
        'the next merge has them',
    )
    assert gate.calls == 2
    node.close()
    node.destroy_node()


def test_a_failing_merge_is_seen_and_the_last_good_map_stays(
    nodes: list[Any], submaps: tuple[SubMap, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    node, observer = nodes
    service = merge_now_service()
    for submap in submaps[:2]:
        observer.send('/submaps', submap)
    spin_until(nodes, lambda: node.session.ledger.received == 2, 'two maps')
    assert observer.call(service, 'merge_now', nodes).result == 0
    spin_until(nodes, lambda: observer.heard.is_complete, 'the good map')
    first = observer.heard.status.revision

    def fail(snapshot: Snapshot, config: FusionConfig, memory: Any) -> Fusion:
        raise ZeroDivisionError('a bug')

    with monkeypatch.context() as patch:
        patch.setattr(merge_loop, 'fuse', fail)
        response = observer.call(service, 'merge_now', nodes)
    assert response.result == service.Response.RESULT_MERGE_FAILED
    assert response.message == 'ZeroDivisionError: a bug'
    spin_until(
        nodes,
        lambda: observer.diagnostics.get('/fusion_node: fusion', (b'',))[0] == b'\2',
        'an error in the diagnostics',
    )
    assert observer.heard.status.revision == first
    assert observer.call(service, 'merge_now', nodes).result == 0
    spin_until(nodes, lambda: observer.heard.status.revision == first + 2, 'and it goes on')


def test_a_huge_message_is_refused(nodes: list[Any]) -> None:
    node, observer = nodes
    node.session.receive('/submaps', bytes(MAX_MESSAGE_BYTES + 1))
    spin_until(nodes, lambda: observer.node_values.get('messages_refused') == '1', 'it is counted')
    assert '128 MiB' in observer.node_values['last_refusal']


def test_maps_can_be_removed_and_all_forgotten(
    nodes: list[Any], submaps: tuple[SubMap, ...]
) -> None:
    from mapmerge_msgs.srv import RemoveMap

    node, observer = nodes
    service = merge_now_service()
    codes = RemoveMap.Response
    answer = observer.call(service, 'merge_now', nodes)
    assert answer.result == service.Response.RESULT_NOTHING_TO_MERGE
    for submap in submaps:
        observer.send('/submaps', submap)
    spin_until(nodes, lambda: len(node.session.ledger.maps) == len(submaps), 'all maps')

    def remove(**names: str) -> tuple[int, int]:
        response = observer.call(RemoveMap, 'remove', nodes, **names)
        return response.result, response.removed

    first, second, *_ = submaps
    assert remove() == (codes.RESULT_EMPTY_REQUEST, 0)
    assert remove(map_id='nobody') == (codes.RESULT_UNKNOWN_MAP, 0)
    assert remove(robot_id='nobody') == (codes.RESULT_UNKNOWN_ROBOT, 0)
    assert remove(map_id=first.map_id, robot_id=second.robot_id)[1] == 0
    assert remove(map_id=first.map_id) == (codes.RESULT_SUCCESS, 1)
    assert remove(robot_id=second.robot_id) == (codes.RESULT_SUCCESS, 1)
    assert observer.call(service, 'merge_now', nodes).status.sub_maps == len(submaps) - 2

    answer = observer.call(Trigger, 'reset', nodes)
    assert (answer.success, answer.message) == (True, f'{len(submaps) - 2} sub-maps forgotten')
    answer = observer.call(service, 'merge_now', nodes)
    assert answer.result == service.Response.RESULT_NOTHING_TO_MERGE
    observer.send('/submaps', first)
    spin_until(nodes, lambda: set(node.session.ledger.maps) == {first.map_id}, 'it may come again')


def test_publishers_of_every_quality_are_heard(
    nodes: list[Any], submaps: tuple[SubMap, ...]
) -> None:
    node, observer = nodes
    kinds = [(reliable, latched) for reliable in (True, False) for latched in (True, False)]
    for k, (reliable, latched) in enumerate(kinds):
        topic = f'/robot{k}/submap'
        observer.send(topic, submaps[0], reliable=reliable, latched=latched)
        spin_until(nodes, lambda topic=topic: observer.heard_by(topic), f'{topic} found')
        changed = replace(submaps[1], map_id=f'map{k}')
        observer.send(topic, changed, reliable=reliable, latched=latched)
        spin_until(nodes, lambda k=k: f'map{k}' in node.session.ledger.maps, kinds[k])
    assert node.session.topics.incompatible == ()


def test_a_volatile_robot_may_join_a_topic_of_latched_ones(
    nodes: list[Any], submaps: tuple[SubMap, ...]
) -> None:
    node, observer = nodes
    observer.send('/submaps', submaps[0])
    spin_until(nodes, lambda: len(node.session.ledger.maps) == 1, 'the latched one')
    observer.send('/submaps', submaps[1], latched=False)
    spin_until(nodes, lambda: observer.heard_by('/submaps') == 2, 'both connected')
    observer.send('/submaps', submaps[2], latched=False)
    spin_until(nodes, lambda: submaps[2].map_id in node.session.ledger.maps, 'the volatile one')


def test_what_cannot_be_heard_is_named(
    observer: Observer, submaps: tuple[SubMap, ...], capfd: pytest.CaptureFixture[str]
) -> None:
    from std_msgs.msg import String

    node = fusion_node(durability='transient_local')
    nodes = [node, observer]
    observer.send('/drone/submap', submaps[0], latched=False)
    observer.create_publisher(String, '/other/submap', 1)
    spin_until(nodes, lambda: node.session.topics.incompatible, 'the volatile publisher is found')
    spin_until(
        nodes,
        lambda: observer.node_values.get('incompatible_publishers'),
        'it is in the diagnostics',
    )
    assert node.session.topics.incompatible == (
        '/observer offers volatile instead of transient_local on /drone/submap',
    )
    assert '/other/submap: of type std_msgs/msg/String' in capfd.readouterr().err
    node.close()
    node.destroy_node()


def test_the_merge_follows_the_clock_of_the_node(
    observer: Observer, submaps: tuple[SubMap, ...]
) -> None:
    from rosgraph_msgs.msg import Clock

    clock = observer.create_publisher(Clock, '/clock', 1)
    node = fusion_node(use_sim_time=True, merge_period=5.0)
    nodes = [node, observer]
    observer.send('/submaps', submaps[0])
    spin_until(nodes, lambda: node.session.ledger.received == 1, 'a map')
    spin_for(nodes, 0.3)
    assert node.session.fusion is None
    message = Clock()

    def tick() -> None:
        message.clock.sec += 1
        clock.publish(message)

    observer.create_timer(0.02, tick)
    spin_until(nodes, lambda: node.session.fusion is not None, 'a merge in the time of the clock')
    spin_until(nodes, lambda: observer.heard.status is not None, 'its status')
    assert 5 <= observer.heard.status.header.stamp.sec <= message.clock.sec
    node.close()
    node.destroy_node()


def test_the_worker_runs_one_merge_at_a_time() -> None:
    gate, woken = threading.Event(), threading.Event()

    def merge(snapshot: Snapshot) -> int:
        assert gate.wait(10)
        return len(snapshot.submaps)

    worker = Worker(merge, woken.set)
    worker.start(Snapshot(()))
    assert worker.busy
    assert worker.take() is None
    with pytest.raises(RuntimeError):
        worker.start(Snapshot(()))
    gate.set()
    assert woken.wait(10)
    result = worker.take()
    assert result is not None
    assert (result.product, result.error) == (0, '')
    assert not worker.busy


def test_a_closed_worker_wakes_nobody() -> None:
    gate, woken = threading.Event(), threading.Event()
    worker = Worker(lambda snapshot: gate.wait(10), woken.set)
    worker.start(Snapshot(()))
    assert not worker.close(timeout_s=0.05)
    gate.set()
    assert worker.close(timeout_s=10)
    assert not woken.is_set()


def test_every_field_of_the_engine_is_a_parameter() -> None:
    settings = {setting.name: setting for setting in parameters.CONFIG_SETTINGS}
    assert set(settings) == {field.name for field in fields(FusionConfig)}
    for setting in (*parameters.NODE_SETTINGS, *parameters.CONFIG_SETTINGS):
        assert setting.description.endswith('.')
        if isinstance(setting.default, (int, float)) and not isinstance(setting.default, bool):
            assert setting.low <= setting.default < setting.high
