# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the node holds: too large, removed, forgotten."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ros_processes import MergeNow, Observer, spin_for, spin_until
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


def test_what_was_forgotten_is_told_to_nobody_who_comes_late(
    nodes: list[Any], drones: tuple[SubMap, ...]
) -> None:
    from mapmerge_msgs.msg import AlignmentArray
    from mapmerge_msgs.msg import SubMap as SubMapMessage
    from sensor_msgs.msg import PointCloud2

    node, observer = nodes
    topic = '/fusion_node/global_map'
    stays = observer.latest(SubMapMessage, topic)
    for submap in drones:
        observer.send('/submaps', submap)
    spin_until(nodes, lambda: len(node.session.ledger.maps) == len(drones), 'all maps')
    observer.merge_now(nodes)
    spin_until(nodes, lambda: stays, 'the map')

    # No merge follows by itself for an hour, nor would one while paused.
    assert observer.call(Trigger, 'reset', nodes).success
    assert node.session.fusion.alignments == ()
    late = Observer(name='late')
    everybody = [*nodes, late]
    found = {
        kind: late.latest(kind, f'/fusion_node/{name}')
        for kind, name in ((AlignmentArray, 'alignments'), (PointCloud2, 'points'))
    }
    map_heard = late.latest(SubMapMessage, topic)
    spin_until(everybody, lambda: all(found.values()), 'what is latched')
    assert found[AlignmentArray]['message'].alignments == []
    assert found[PointCloud2]['message'].width == 0
    spin_for(everybody, 0.3)
    assert not map_heard

    # Who stays hears the next one, as who came late does.
    stays.clear()
    for submap in drones:
        observer.send('/submaps', submap)
    spin_until(everybody, lambda: len(node.session.ledger.maps) == len(drones), 'again')
    observer.merge_now(everybody)
    spin_until(everybody, lambda: stays and map_heard, 'the next map')
    late.destroy_node()


def test_a_map_of_which_nothing_is_left_is_told_to_nobody(
    nodes: list[Any], drones: tuple[SubMap, ...]
) -> None:
    from mapmerge_msgs.msg import SubMap as SubMapMessage
    from mapmerge_msgs.srv import RemoveMap

    node, observer = nodes
    observer.send('/submaps', drones[0])
    spin_until(nodes, lambda: node.session.ledger.maps, 'a map')
    observer.merge_now(nodes)
    assert observer.call(RemoveMap, 'remove', nodes, map_id=drones[0].map_id).removed == 1
    observer.merge_now(nodes)
    late = observer.latest(SubMapMessage, '/fusion_node/global_map')
    spin_for(nodes, 0.5)
    assert not late


def test_a_robot_of_which_nothing_was_taken_in_can_be_removed(
    nodes: list[Any], drones: tuple[SubMap, ...]
) -> None:
    from mapmerge_msgs.srv import RemoveMap

    node, observer = nodes
    ledger = node.session.ledger
    observer.send('/a/submap', drones[0])
    spin_until(nodes, lambda: ledger.maps, 'a map')
    observer.send('/ghost/submap', replace(drones[0], robot_id='ghost'))
    spin_until(nodes, lambda: ledger.robots.get('ghost'), 'another robot with its name')
    assert ledger.robots['ghost'].trouble
    answer = observer.call(RemoveMap, 'remove', nodes, map_id='x', robot_id='ghost')
    assert answer.result == RemoveMap.Response.RESULT_UNKNOWN_MAP
    answer = observer.call(RemoveMap, 'remove', nodes, robot_id='ghost')
    assert (answer.result, answer.removed) == (RemoveMap.Response.RESULT_SUCCESS, 0)
    assert set(ledger.robots) == {drones[0].robot_id}
    assert set(ledger.maps) == {drones[0].map_id}
