# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What an operator is told: levels, reasons, and values that the documentation explains."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros_processes import spin_until
from test_node_fleets import S, submap_of

from mapmerge_ros.fusion import Receipt
from mapmerge_ros.io import encode_submap
from mapmerge_ros.nodes.diagnostics import LONG_MERGE_S, REFUSAL_WARNS_NS, Health
from mapmerge_ros.nodes.ledger import Ledger
from mapmerge_ros.submap import SubMap

DOCS = Path(__file__).parents[1] / 'docs' / 'node.md'
OK, WARN, ERROR, STALE = b'\0', b'\1', b'\2', b'\3'


def documented(start: str) -> set[str]:
    """Names in the first column of the table that follows."""
    text = DOCS.read_text()
    text = text[text.index('### Diagnostics') :]
    table = text[text.index(start) :].split('\n\n')[1]
    rows = [line.split('|')[1] for line in table.splitlines() if line.startswith('| `')]
    return {name for row in rows for name in re.findall(r'`(\w+)`', row)}


def stranger() -> SubMap:
    """A map of another scene, whose ids mean nothing to the others."""
    return replace(submap_of(1, 9, 1, 9 * S), id_space='elsewhere')


def test_every_value_is_explained_and_every_robot_has_its_reason(nodes: list[Any]) -> None:
    node, observer = nodes
    for submap in (*(submap_of(0, k, 1, k * S) for k in range(3)), stranger()):
        observer.send(f'/{submap.robot_id}/submap', submap)
    spin_until(nodes, lambda: node.session.ledger.received == 4, 'four robots')
    observer.merge_now(nodes)
    spin_until(nodes, lambda: 'merged' in observer.node_values, 'the diagnostics of the merge')

    level, message, values = observer.diagnostics['/fusion_node: fusion']
    assert set(values) == documented('Values of the node:')
    assert (level, message) == (WARN, '1 sub-maps detached')
    assert (values['robots'], values['merged'], values['detached']) == ('4', '3', '1')
    assert float(values['merge_total_s']) > 0.0
    assert float(values['p_value']) > 0.01

    level, message, values = observer.diagnostics['/fusion_node: robot d1']
    assert set(values) == documented('Of a robot:')
    assert (level, message, values['state'], values['reason']) == (OK, 'merged', 'merged', '')
    assert (values['topic'], values['maps'], values['revision']) == ('/d1/submap', '1', 'd1/0:1')
    assert int(values['landmarks']) == 40
    assert float(values['bytes_per_s']) > 0.0
    submap = submap_of(0, 1, 1, S)
    ratio = 4 * submap.residual_count / len(encode_submap(submap))
    assert float(values['compression_ratio']) == pytest.approx(ratio, rel=5e-3)

    level, message, values = observer.diagnostics['/fusion_node: robot d9']
    assert (level, values['state']) == (WARN, 'detached')
    assert message == values['reason'] != ''


def health(ledger: Ledger, **changes: Any) -> Any:
    values = {'name': '/node', 'now_ns': 100 * S, 'ledger': ledger, 'fusion': None}
    values |= {'merged_ns': None, 'error': '', 'incompatible': ()}
    return Health(**{**values, **changes})


def worst(found: Any) -> bytes:
    level: bytes = found.message(None).status[0].level
    return level


def test_levels_of_the_node() -> None:
    ledger = Ledger()
    assert worst(health(ledger)) == OK
    assert worst(health(ledger, mode='paused')) == OK
    assert worst(health(ledger, incompatible=('/x offers too little',))) == WARN
    assert worst(health(ledger, error='a bug', incompatible=('/x',))) == ERROR
    ledger.refuse('/x/submap', 'points: nonsense', 99 * S)
    assert worst(health(ledger)) == WARN
    assert worst(health(ledger, now_ns=99 * S + REFUSAL_WARNS_NS)) == OK
    assert worst(health(Ledger(), merging_s=LONG_MERGE_S - 1.0)) == OK
    assert worst(health(Ledger(), merging_s=LONG_MERGE_S + 1.0)) == WARN


def test_levels_of_a_robot() -> None:
    ledger, submap = Ledger(), submap_of(0, 0, 1, 0)
    ledger.hear(submap, '/d0/submap', 1000, 10 * S, Receipt(True))
    ledger.see(frozenset({'/d0/submap'}), 95 * S)
    for timeout_s, level in ((0.0, OK), (6.0, OK), (4.0, STALE)):
        (_, robot) = health(ledger, robot_timeout_s=timeout_s).message(None).status
        assert (robot.level, robot.hardware_id) == (level, 'd0')
    values = {item.key: item.value for item in robot.values}
    assert (values['last_heard_s_ago'], values['absent_s']) == ('90.0', '5.0')
    assert values['state'] == 'received'
    np.testing.assert_allclose(float(values['bytes_per_s']), 1000 / 90.0, atol=0.5)


def entry(found: Any, name: str) -> Any:
    return next(item for item in found.message(None).status if item.name == name)


def test_what_was_left_out_is_told_until_something_better_comes() -> None:
    ledger, submap = Ledger(), submap_of(0, 0, 1, 0)
    ledger.hear(submap, '/d0/submap', 1000, 10 * S, Receipt(True))
    ledger.hear(submap, '/d0/submap', 1000, 11 * S, Receipt(False, 'not newer'))
    assert entry(health(ledger), '/node: robot d0').level == OK, 'a repetition is no trouble'
    ledger.hear(submap, '/d0/submap', 1000, 12 * S, Receipt(False, 'changed', conflict=True))
    robot = entry(health(ledger), '/node: robot d0')
    assert (robot.level, robot.message) == (
        WARN,
        'newest message left out: d0/0: changed; received',
    )
    assert {item.key: item.value for item in robot.values}['ignored'] == '2'
    ledger.hear(submap, '/d0/submap', 1000, 13 * S, Receipt(True))
    assert entry(health(ledger), '/node: robot d0').level == OK
    ledger.refuse('/d0/submap', 'r: nonsense', 14 * S)
    robot = entry(health(ledger), '/node: robot d0')
    assert robot.message.startswith('newest message left out: r: nonsense')
    ledger.hear(submap, '/d0/submap', 1000, 15 * S, Receipt(False, 'not newer'))
    assert entry(health(ledger), '/node: robot d0').level == OK


def test_who_only_ever_sends_nonsense_is_told_by_topic() -> None:
    ledger = Ledger()
    ledger.refuse('/bad/submap', 'r: nonsense', 0)
    found = entry(health(ledger), '/node: topic /bad/submap')
    assert (found.level, 'r: nonsense' in found.message) == (WARN, True)
    ledger.see(frozenset(), 100 * S)
    assert len(health(ledger).message(None).status) == 1, 'nobody publishes there any more'


def test_what_waits_for_the_next_merge_is_not_called_merged(nodes: list[Any]) -> None:
    node, observer = nodes
    robot = '/fusion_node: robot d1'
    for k in range(2):
        observer.send(f'/d{k}/submap', submap_of(0, k, 1, k * S))
    spin_until(nodes, lambda: node.session.ledger.received == 2, 'two robots')
    observer.merge_now(nodes)
    node.session.merges.paused = True
    observer.send('/d1/submap', submap_of(0, 1, 2, 5 * S))
    spin_until(nodes, lambda: node.session.ledger.received == 3, 'a revision')
    spin_until(
        nodes,
        lambda: observer.diagnostics.get(robot, ('', '', {}))[2].get('waiting') == 'd1/0:2',
        'it waits',
    )
    _, message, _ = observer.diagnostics[robot]
    assert message == 'merged; d1/0:2 waits for the next merge'
