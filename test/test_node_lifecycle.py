# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The fusion node as a managed node, over its services."""

from __future__ import annotations

from typing import Any

import pytest
from ros_processes import FUSION, PATIENCE_S, REMEDY, Observer, spin_for, spin_until

from mapmerge_ros.cli.processes import Children
from mapmerge_ros.submap import SubMap

lifecycle = pytest.importorskip('lifecycle_msgs.srv', reason=REMEDY)
interfaces = pytest.importorskip('rcl_interfaces.srv', reason=REMEDY)
parameters = pytest.importorskip('rcl_interfaces.msg', reason=REMEDY)
srv = pytest.importorskip('mapmerge_msgs.srv', reason=REMEDY)


def change(observer: Observer, transition: str) -> bool:
    request = lifecycle.ChangeState.Request()
    request.transition.label = transition
    answer = observer.call(lifecycle.ChangeState, 'change_state', transition=request.transition)
    return bool(answer.success)


def state(observer: Observer) -> str:
    return str(observer.call(lifecycle.GetState, 'get_state').current_state.label)


def test_a_manager_brings_it_up_and_down(
    children: Children, observer: Observer, drones: tuple[SubMap, ...]
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.1, 'autostart': False})
    for submap in drones[:2]:
        observer.send('/submaps', submap)
    assert state(observer) == 'unconfigured'
    assert change(observer, 'configure')
    assert state(observer) == 'inactive'
    answer = observer.merge_now()
    assert answer.result == srv.MergeNow.Response.RESULT_NOT_ACTIVE
    spin_until([observer], lambda: observer.node_values.get('mode') == 'inactive', 'it tells')
    assert observer.heard_by('/submaps') == 0

    assert change(observer, 'activate')
    heard = observer.heard
    spin_until([observer], lambda: heard.is_complete and heard.status.merged == 2, 'merged')
    assert change(observer, 'deactivate')
    spin_until([observer], lambda: not observer.heard_by('/submaps'), 'it does not listen')
    observer.send('/submaps', drones[2])
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
    assert set(children.stop(PATIENCE_S).values()) == {0}
    assert 'Traceback' not in children.log('fusion').read_text()


def test_an_impossible_transition_is_answered_and_survived(
    children: Children, observer: Observer
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.1})
    spin_until([observer], lambda: state(observer) == 'active', 'it is up')
    request = lifecycle.ChangeState.Request()
    for wrong in (1, 99):  # configure, and what nobody knows
        request.transition.id = wrong
        answer = observer.call(
            lifecycle.ChangeState, 'change_state', transition=request.transition
        )
        assert not answer.success
    assert state(observer) == 'active'
    assert change(observer, 'deactivate')
    assert children.ended() == ''
    assert 'is not possible while active' in children.log('fusion').read_text()


def test_inactive_it_takes_parameters_and_tells_of_its_last_merge(
    children: Children, observer: Observer, drones: tuple[SubMap, ...]
) -> None:
    children.start('fusion', FUSION, {'merge_period': 0.1})
    for submap in drones[:2]:
        observer.send('/submaps', submap)
    spin_until([observer], lambda: observer.merged == 2, 'merged')
    assert change(observer, 'deactivate')
    answer = observer.merge_now()
    assert answer.result == srv.MergeNow.Response.RESULT_NOT_ACTIVE
    assert (answer.status.merged, answer.status.revision) == (2, observer.heard.status.revision)

    double = parameters.ParameterValue(type=3, double_value=0.2)
    integer = parameters.ParameterValue(type=2, integer_value=5)
    for name, value in (('merge_period', double), ('max_ellipsoids', integer)):
        parameter = parameters.Parameter(name=name, value=value)
        found = observer.call(interfaces.SetParameters, 'set_parameters', parameters=[parameter])
        assert found.results[0].successful
    assert change(observer, 'activate')
    observer.send('/submaps', drones[2])
    spin_until([observer], lambda: observer.merged == 3, 'it goes on')
    assert children.ended() == ''


def maps(heard: Any) -> set[str]:
    return {item.map_id for item in heard.alignments.alignments}
