# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fusion node as a managed node, and its parameters, over their services."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ros_processes import (
    FUSION,
    REMEDY,
    Observer,
    load,
    make_recording,
    observing,
    rclpy,
    spin_for,
    spin_until,
)

from mapmerge_ros.cli.processes import Children, free_domain
from mapmerge_ros.nodes.live_parameters import own_settings
from mapmerge_ros.submap import SubMap

lifecycle = pytest.importorskip('lifecycle_msgs.srv', reason=REMEDY)
interfaces = pytest.importorskip('rcl_interfaces.srv', reason=REMEDY)
srv = pytest.importorskip('mapmerge_msgs.srv', reason=REMEDY)


@pytest.fixture(scope='module')
def submaps(tmp_path_factory: pytest.TempPathFactory) -> tuple[SubMap, ...]:
    return load(make_recording(tmp_path_factory.mktemp('recording')))


@pytest.fixture
def children(tmp_path: Path) -> Iterator[Children]:
    with Children(free_domain(), tmp_path / 'logs') as started:
        yield started


@pytest.fixture
def observer(children: Children) -> Iterator[Observer]:
    with observing(children.domain) as node:
        yield node


def change(observer: Observer, transition: str) -> bool:
    request = lifecycle.ChangeState.Request()
    request.transition.label = transition
    answer = observer.call(lifecycle.ChangeState, 'change_state', transition=request.transition)
    return bool(answer.success)


def state(observer: Observer) -> str:
    return str(observer.call(lifecycle.GetState, 'get_state').current_state.label)


def test_a_manager_brings_it_up_and_down(
    children: Children, observer: Observer, submaps: tuple[SubMap, ...]
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.1, 'autostart': False})
    for submap in submaps[:2]:
        observer.send('/submaps', submap)
    assert state(observer) == 'unconfigured'
    assert change(observer, 'configure')
    assert state(observer) == 'inactive'
    answer = observer.call(srv.MergeNow, 'merge_now')
    assert answer.result == srv.MergeNow.Response.RESULT_NOT_ACTIVE
    spin_until([observer], lambda: observer.node_values.get('mode') == 'inactive', 'it tells')
    assert observer.heard_by('/submaps') == 0

    assert change(observer, 'activate')
    heard = observer.heard
    spin_until([observer], lambda: heard.is_complete and heard.status.merged == 2, 'merged')
    assert change(observer, 'deactivate')
    spin_until([observer], lambda: not observer.heard_by('/submaps'), 'it does not listen')
    observer.send('/submaps', submaps[2])
    spin_for([observer], 0.3)
    assert heard.status.merged == 2
    assert change(observer, 'activate')
    spin_until([observer], lambda: heard.is_complete and heard.status.merged == 3, 'it goes on')

    assert not change(observer, 'cleanup'), 'only while inactive'
    assert change(observer, 'deactivate')
    assert change(observer, 'cleanup')
    assert state(observer) == 'unconfigured'
    spin_until(
        [observer],
        lambda: not observer.get_publishers_info_by_topic('/fusion_node/global_map'),
        'its topics are gone',
    )
    revision = heard.status.revision
    assert change(observer, 'configure')
    assert change(observer, 'activate')
    spin_until(
        [observer],
        lambda: heard.is_complete and heard.status.revision >= revision and len(maps(heard)) == 3,
        'latched maps come again',
    )
    assert change(observer, 'deactivate')
    assert change(observer, 'cleanup')
    assert children.ended() == ''
    assert set(children.stop().values()) == {0}
    assert 'Traceback' not in children.log('fusion').read_text()


def maps(heard: Any) -> set[str]:
    return {item.map_id for item in heard.alignments.alignments}


def test_every_parameter_tells_what_it_means_and_what_it_may_be(
    children: Children, observer: Observer
) -> None:
    children.start('fusion', FUSION, {})
    settings = own_settings('/', 'fusion_node')
    names = [setting.name for setting in settings]
    found = observer.call(interfaces.DescribeParameters, 'describe_parameters', names=names)
    values = observer.call(interfaces.GetParameters, 'get_parameters', names=names).values
    for setting, descriptor, value in zip(settings, found.descriptors, values, strict=True):
        assert descriptor.name == setting.name
        assert descriptor.description == setting.description
        assert setting.change.value in descriptor.additional_constraints
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        assert bool(ranges) == (setting.low != setting.high)
        for limits in ranges:
            assert (limits.from_value, limits.to_value) == (setting.low, setting.high)
        assert rclpy.parameter.parameter_value_to_python(value) == setting.default


def test_parameters_change_where_that_makes_sense(
    children: Children, observer: Observer, submaps: tuple[SubMap, ...]
) -> None:
    children.start('fusion', FUSION, {'merge_period': 3600})

    def put(name: str, value: Any) -> str:
        parameter = rclpy.Parameter(name, value=value).to_parameter_msg()
        answer = observer.call(interfaces.SetParameters, 'set_parameters', parameters=[parameter])
        (result,) = answer.results
        assert result.successful == (not result.reason)
        return str(result.reason)

    assert 'unconfigured' in put('global_frame', 'world')
    assert 'unconfigured' in put('discovery_pattern', '.*')
    assert put('autostart', False)
    assert put('merge_period', -1.0)
    assert put('min_shared', 2)
    assert put('significance', 'x')
    for submap in submaps[:2]:
        observer.send('/submaps', submap)
    spin_until([observer], lambda: observer.node_values.get('sub_maps') == '2', 'two maps')
    assert put('min_shared', 1000) == ''
    assert observer.call(srv.MergeNow, 'merge_now').status.merged == 0
    assert put('min_shared', 4) == ''
    assert put('merge_period', 0.1) == ''
    spin_until(
        [observer],
        lambda: observer.heard.is_complete and observer.heard.status.merged == 2,
        'a merge with the new settings, at the new period',
    )
    assert observer.call(lifecycle.GetState, 'get_state').current_state.label == 'active'
    assert change(observer, 'deactivate')
    assert change(observer, 'cleanup')
    assert put('global_frame', 'world') == ''
    assert change(observer, 'configure')
    assert change(observer, 'activate')
    spin_until(
        [observer],
        lambda: observer.heard.is_complete and observer.heard.status.header.frame_id == 'world',
        'the new frame',
    )
