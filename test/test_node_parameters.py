# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The parameters of the nodes: described, checked, changed while it runs."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from ros_processes import (
    COMPRESSOR,
    FUSION,
    RECORDER,
    REMEDY,
    ROBOT,
    SHIPPED,
    Observer,
    rclpy,
    spin_until,
)

from mapmerge_ros.cli.processes import Children
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.nodes import compressor_parameters, parameters, record_node, robot_node
from mapmerge_ros.nodes.live_parameters import own_settings
from mapmerge_ros.nodes.settings import Setting
from mapmerge_ros.submap import SubMap

lifecycle = pytest.importorskip('lifecycle_msgs.srv', reason=REMEDY)
interfaces = pytest.importorskip('rcl_interfaces.srv', reason=REMEDY)
srv = pytest.importorskip('mapmerge_msgs.srv', reason=REMEDY)


EVERYWHERE = {'use_sim_time', 'start_type_description_service'}
"""Parameters that rclpy gives to a node."""


def change(observer: Observer, transition: str) -> bool:
    request = lifecycle.ChangeState.Request()
    request.transition.label = transition
    answer = observer.call(lifecycle.ChangeState, 'change_state', transition=request.transition)
    return bool(answer.success)


NODES: dict[str, tuple[str, Sequence[Setting], dict[str, Any]]] = {
    'fusion_node': (FUSION, own_settings('/', 'fusion_node'), {}),
    'compressor_node': (COMPRESSOR, compressor_parameters.SETTINGS, {}),
    'robot_node': (ROBOT, robot_node.SETTINGS, {'recording': str(SHIPPED), 'robot_id': 'drone0'}),
    'mapmerge_recorder': (RECORDER, record_node.SETTINGS, {'output': 'out.mcap'}),
}
"""Node to module, settings, and values that have to be given"""


@pytest.mark.parametrize('name', NODES)
def test_every_parameter_tells_what_it_means_and_what_it_may_be(
    name: str,
    children: Children,
    observer: Observer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    module, settings, given = NODES[name]
    children.start(name, module, given)
    listener = Observer(f'/{name}', 'listener')
    nodes = [observer]

    def ask(kind: Any, service: str, **fields: Any) -> Any:
        return listener.call(kind, service, nodes, **fields)

    listed = ask(interfaces.ListParameters, 'list_parameters').result.names
    names = [setting.name for setting in settings]
    assert set(listed) - EVERYWHERE == set(names)
    found = ask(interfaces.DescribeParameters, 'describe_parameters', names=names)
    values = ask(interfaces.GetParameters, 'get_parameters', names=names).values
    listener.destroy_node()
    for setting, descriptor, value in zip(settings, found.descriptors, values, strict=True):
        assert descriptor.name == setting.name
        assert descriptor.description == setting.description
        assert setting.change.value in descriptor.additional_constraints
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        assert len(ranges) == (type(setting.default) in (int, float))
        for limits in ranges:
            assert (limits.from_value, limits.to_value) == (setting.low, setting.high)
        expected = given.get(setting.name, setting.default)
        assert rclpy.parameter.parameter_value_to_python(value) == expected


def test_parameters_change_where_that_makes_sense(
    children: Children, observer: Observer, drones: tuple[SubMap, ...]
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
    for submap in drones[:2]:
        observer.send('/submaps', submap)
    spin_until([observer], lambda: observer.node_values.get('sub_maps') == '2', 'two maps')
    assert put('min_shared', 1000) == ''
    assert observer.merge_now().status.merged == 0
    assert put('min_shared', 4) == ''
    assert put('merge_period', 0.1) == ''
    spin_until(
        [observer],
        lambda: observer.merged == 2,
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


def test_every_field_of_the_engine_is_a_parameter() -> None:
    settings = {setting.name: setting for setting in parameters.CONFIG_SETTINGS}
    assert set(settings) == {field.name for field in fields(FusionConfig)}
    for setting in (*parameters.NODE_SETTINGS, *parameters.CONFIG_SETTINGS):
        assert setting.description.endswith('.')
        if isinstance(setting.default, (int, float)) and not isinstance(setting.default, bool):
            assert setting.low <= setting.default < setting.high


def test_a_parameter_that_is_not_there_is_told(children: Children, observer: Observer) -> None:
    children.start('fusion', FUSION, {'min_shraed': 5, 'foo': 3, 'merge_period': 0.5})
    spin_until([observer], lambda: 'mode' in observer.node_values, 'it runs')
    log = children.log('fusion').read_text()
    assert 'there is no parameter min_shraed, what was given for it is ignored: min_shared' in log
    assert 'there is no parameter foo, what was given for it is ignored' in log
    assert 'merge_period' not in log


@pytest.mark.parametrize('name', NODES)
def test_a_node_explains_itself(name: str) -> None:
    module, settings, _ = NODES[name]
    call = [sys.executable, '-m', module]
    asked = subprocess.run([*call, '--help'], capture_output=True, text=True, check=True)
    assert asked.stdout.startswith('usage: ')
    for setting in settings:
        assert f'{setting.name} (default' in asked.stdout
    wrong = subprocess.run([*call, '--foo'], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2
    assert wrong.stderr == 'unexpected: --foo; parameters: --ros-args -p NAME:=VALUE\n'
