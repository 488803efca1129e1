# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Publishers of every quality of service are heard, or named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from ros_processes import Observer, spin_until

from mapmerge_ros.submap import SubMap


def test_publishers_of_every_quality_are_heard(
    nodes: list[Any], drones: tuple[SubMap, ...]
) -> None:
    node, observer = nodes
    kinds = [(reliable, latched) for reliable in (True, False) for latched in (True, False)]
    for k, (reliable, latched) in enumerate(kinds):
        topic = f'/robot{k}/submap'
        observer.send(topic, drones[0], reliable=reliable, latched=latched)
        spin_until(nodes, lambda topic=topic: observer.heard_by(topic), f'{topic} found')
        changed = replace(drones[1], map_id=f'map{k}')
        observer.send(topic, changed, reliable=reliable, latched=latched)
        spin_until(nodes, lambda k=k: f'map{k}' in node.session.ledger.maps, kinds[k])
    assert node.session.topics.incompatible == ()


def test_a_volatile_robot_may_join_a_topic_of_latched_ones(
    nodes: list[Any], drones: tuple[SubMap, ...]
) -> None:
    node, observer = nodes
    observer.send('/submaps', drones[0])
    spin_until(nodes, lambda: len(node.session.ledger.maps) == 1, 'the latched one')
    observer.send('/submaps', drones[1], latched=False)
    spin_until(nodes, lambda: observer.heard_by('/submaps') == 2, 'both connected')
    observer.send('/submaps', drones[2], latched=False)
    spin_until(nodes, lambda: drones[2].map_id in node.session.ledger.maps, 'the volatile one')


def test_what_cannot_be_heard_is_named(
    observer: Observer,
    fusion_node: Callable[..., Any],
    drones: tuple[SubMap, ...],
    capfd: pytest.CaptureFixture[str],
) -> None:
    from std_msgs.msg import String

    node = fusion_node(durability='transient_local')
    nodes = [node, observer]
    observer.send('/drone/submap', drones[0], latched=False)
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
