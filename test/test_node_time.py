# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Node time: the clock of a recording, and one that is set back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from ros_processes import Observer, spin_for, spin_until

from mapmerge_ros.submap import SubMap


def test_the_merge_follows_the_clock_of_the_node(
    observer: Observer, fusion_node: Callable[..., Any], drones: tuple[SubMap, ...]
) -> None:
    from rosgraph_msgs.msg import Clock

    clock = observer.create_publisher(Clock, '/clock', 1)
    node = fusion_node(use_sim_time=True, merge_period=5.0)
    nodes = [node, observer]
    observer.send('/submaps', drones[0])
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


def test_a_recording_that_starts_again_disturbs_nothing(
    observer: Observer, fusion_node: Callable[..., Any], drones: tuple[SubMap, ...]
) -> None:
    from rosgraph_msgs.msg import Clock

    clock = observer.create_publisher(Clock, '/clock', 1)
    node = fusion_node(use_sim_time=True, merge_period=2.0, robot_timeout=5.0)
    nodes = [node, observer]
    message = Clock()

    def tick() -> None:
        message.clock.sec += 1
        clock.publish(message)

    observer.create_timer(0.02, tick)
    message.clock.sec = 1000
    observer.send('/submaps', drones[0])
    spin_until(nodes, lambda: node.session.fusion is not None, 'a merge')
    message.clock.sec = 10
    spin_until(nodes, lambda: node.session.now_ns < 900 * 10**9, 'the clock was set back')
    for submap in drones[:2]:
        observer.send('/submaps', submap)
    spin_until(nodes, lambda: observer.merged == 2, 'a merge in the new time')
    assert observer.heard.status.header.stamp.sec < 900
    (record, *_) = node.session.ledger.robots.values()
    assert record.first_ns <= record.last_ns < 900 * 10**9
    assert node.session.ledger.ignored == 1, 'what was known is known'


def test_what_came_before_the_first_time_came_at_the_first_time(
    observer: Observer, fusion_node: Callable[..., Any], drones: tuple[SubMap, ...]
) -> None:
    from rosgraph_msgs.msg import Clock

    clock = observer.create_publisher(Clock, '/clock', 1)
    node = fusion_node(use_sim_time=True, merge_period=3600.0)
    ledger, nodes = node.session.ledger, [node, observer]
    observer.send('/submaps', drones[0])
    spin_until(nodes, lambda: ledger.received == 1, 'a map')
    node.session.receive('/submaps', b'nonsense')
    assert observer.merge_now(nodes).status.sub_maps == 1
    (record,) = ledger.robots.values()
    assert record.first_ns == 0
    message = Clock()

    def reach(sec: int) -> None:
        message.clock.sec = sec
        clock.publish(message)
        spin_until(nodes, lambda: node.session.now_ns == sec * 10**9, 'the time of the clock')

    first = 1_700_000_000
    spin_until(nodes, lambda: clock.get_subscription_count(), 'the clock is heard')
    reach(first)
    assert record.first_ns == record.last_ns == record.seen_ns == first * 10**9
    assert ledger.last_refusal_ns == first * 10**9
    # A clock that leaps later on has let this time pass.
    reach(first + 10)
    assert record.first_ns == first * 10**9
    assert record.messages_per_s(node.session.now_ns) == pytest.approx(0.1)
    spin_until(
        nodes,
        lambda: observer.node_values.get('last_merge_s_ago') == '10.0',
        'the age of the merge',
    )
