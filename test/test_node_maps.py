# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the node holds: too large, removed, forgotten."""

from __future__ import annotations

from typing import Any

from ros_processes import MergeNow, spin_until
from std_srvs.srv import Trigger

from mapmerge_ros.io import MAX_MESSAGE_BYTES
from mapmerge_ros.submap import SubMap


def test_a_huge_message_is_refused(nodes: list[Any]) -> None:
    node, observer = nodes
    node.session.receive('/submaps', bytes(MAX_MESSAGE_BYTES + 1))
    spin_until(nodes, lambda: observer.node_values.get('messages_refused') == '1', 'it is counted')
    assert '128 MiB' in observer.node_values['last_refusal']


def test_maps_can_be_removed_and_all_forgotten(
    nodes: list[Any], drones: tuple[SubMap, ...]
) -> None:
    from mapmerge_msgs.srv import RemoveMap

    node, observer = nodes
    codes = RemoveMap.Response
    answer = observer.merge_now(nodes)
    assert answer.result == MergeNow.Response.RESULT_NOTHING_TO_MERGE
    for submap in drones:
        observer.send('/submaps', submap)
    spin_until(nodes, lambda: len(node.session.ledger.maps) == len(drones), 'all maps')

    def remove(**names: str) -> tuple[int, int]:
        response = observer.call(RemoveMap, 'remove', nodes, **names)
        return response.result, response.removed

    first, second, *_ = drones
    assert remove() == (codes.RESULT_EMPTY_REQUEST, 0)
    assert remove(map_id='nobody') == (codes.RESULT_UNKNOWN_MAP, 0)
    assert remove(robot_id='nobody') == (codes.RESULT_UNKNOWN_ROBOT, 0)
    assert remove(map_id=first.map_id, robot_id=second.robot_id)[1] == 0
    assert remove(map_id=first.map_id) == (codes.RESULT_SUCCESS, 1)
    assert remove(robot_id=second.robot_id) == (codes.RESULT_SUCCESS, 1)
    assert observer.merge_now(nodes).status.sub_maps == len(drones) - 2

    answer = observer.call(Trigger, 'reset', nodes)
    assert (answer.success, answer.message) == (True, f'{len(drones) - 2} sub-maps forgotten')
    answer = observer.merge_now(nodes)
    assert answer.result == MergeNow.Response.RESULT_NOTHING_TO_MERGE
    observer.send('/submaps', first)
    spin_until(nodes, lambda: set(node.session.ledger.maps) == {first.map_id}, 'it may come again')
