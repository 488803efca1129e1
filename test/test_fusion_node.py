# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fusion node on real topics: what the replay finds, whatever is sent."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_processes import FUSION, PATIENCE_S, ROBOT, Observer, spin_until

from mapmerge_ros.cli.processes import Children
from mapmerge_ros.fusion import Fusion, FusionConfig, fuse
from mapmerge_ros.geometry import align
from mapmerge_ros.io import create, decode_submap, encode_submap, submap_to_message
from mapmerge_ros.io.codec import serialise
from mapmerge_ros.nodes.outgoing import covariance_of_parts
from mapmerge_ros.submap import Source, SubMap


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
    children: Children, observer: Observer, drones_recording: Path, drones: tuple[SubMap, ...]
) -> None:
    from mapmerge_msgs.msg import ChangeArray

    for robot_id in sorted({submap.robot_id for submap in drones}):
        values = {'recording': str(drones_recording), 'robot_id': robot_id, 'rate': 0}
        children.start(robot_id, ROBOT, values)
    spin_until(
        [observer],
        lambda: all('sent' in children.log(x.robot_id).read_text() for x in drones),
        'the robots have sent',
    )
    children.start('fusion', FUSION, {'merge_period': 3600})
    spin_until(
        [observer],
        lambda: observer.node_values.get('sub_maps') == str(len(drones)),
        'the node has what was sent before it was there',
    )
    response = observer.merge_now()
    spin_until([observer], lambda: observer.heard.is_complete, 'the result')
    expected = fuse(drones, FusionConfig(map_id='fusion_node/global'))
    assert response.result == 0
    assert response.status.a_tilde == observer.heard.status.a_tilde
    assert_equal_to_replay(observer, expected)

    late = Observer(name='late')
    changes = late.latest(ChangeArray, '/fusion_node/changes')
    spin_until(
        [late], lambda: late.heard.is_complete and changes, 'the latest for a late listener'
    )
    assert changes['message'].header.stamp == late.heard.status.header.stamp
    assert encode_submap(late.heard.global_map) == encode_submap(observer.heard.global_map)
    late.destroy_node()

    assert children.ended() == ''
    codes = children.stop(PATIENCE_S)
    assert set(codes.values()) == {0}, codes
    for name in codes:
        assert 'Traceback' not in children.log(name).read_text()


def broken(submap: SubMap, map_id: str, **changes: Any) -> bytes:
    """Message of a sub-map with fields that no sub-map could have."""
    message = submap_to_message(replace(submap, map_id=map_id), create)
    for name, value in changes.items():
        setattr(message, name, value)
    return serialise(message)


def test_what_is_wrong_is_refused_and_disturbs_nothing(
    children: Children, observer: Observer, drones: tuple[SubMap, ...]
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.2})
    first, second, *_ = drones
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
    children: Children, observer: Observer, drones: tuple[SubMap, ...]
) -> None:
    near, far = drones[:2], drones[2:]
    topics = '|'.join(map(submap_topic, near))
    children.start(
        'site', FUSION, {'merge_period': 0.2, 'discovery_pattern': topics}, {'__ns': '/site'}
    )
    topics = '|'.join(['/site/.*/global_map', *map(submap_topic, far)])
    children.start('fusion', FUSION, {'merge_period': 0.2, 'discovery_pattern': topics})
    for submap in drones:
        observer.send(submap_topic(submap), submap)
    spin_until(
        [observer],
        lambda: (
            observer.heard.is_complete
            and observer.heard.status.merged == 1 + len(far)
            and observer.heard.global_map.sources == leaves(*drones)
        ),
        'a map of a map and of sub-maps',
    )
    names = {item.map_id for item in observer.heard.alignments.alignments}
    assert names == {'site/fusion_node/global', *(submap.map_id for submap in far)}
    expected = fuse(drones).global_map
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
    name: str, children: Children, observer: Observer, drones_recording: Path
) -> None:
    if name == 'fusion':
        process = children.start(name, FUSION, {'merge_period': -1.0})
    else:
        process = children.start(
            name, ROBOT, {'recording': str(drones_recording), 'robot_id': 'x'}
        )
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
