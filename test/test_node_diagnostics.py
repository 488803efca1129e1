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
from mapmerge_ros.io import InvalidMessage, decode_submap, encode_submap
from mapmerge_ros.io.codec import deserialise, serialise
from mapmerge_ros.io.sender import Sender, sender_of_submap
from mapmerge_ros.io.typestore import SUBMAP
from mapmerge_ros.nodes.diagnostics import LONG_MERGE_S, REFUSAL_WARNS_NS, Health
from mapmerge_ros.nodes.ledger import MAX_SENDERS, Ledger
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


def fleet_on_one_topic() -> Ledger:
    ledger = Ledger()
    for k in range(3):
        ledger.hear(submap_of(0, k, 1, 0), '/submaps', 1000, 10 * S, Receipt(True))
    return ledger


def warned(ledger: Ledger) -> set[str]:
    _, *entries = health(ledger).message(None).status
    return {item.name.removeprefix('/node: ') for item in entries if item.level != OK}


def test_on_a_shared_topic_only_who_is_named_is_to_blame() -> None:
    ledger = fleet_on_one_topic()
    ledger.refuse('/submaps', 'r: nonsense', 11 * S, Sender('d1/0', 'd1'))
    assert warned(ledger) == {'robot d1'}
    ledger.hear(submap_of(0, 2, 1, 0), '/submaps', 1000, 12 * S, Receipt(False, 'not newer'))
    assert warned(ledger) == {'robot d1'}, 'no other can make up for it'
    ledger.hear(submap_of(0, 1, 1, 0), '/submaps', 1000, 13 * S, Receipt(False, 'not newer'))
    assert warned(ledger) == set()
    ledger.refuse('/submaps', 'robot_id: nonsense', 14 * S, Sender('d2/0'))
    assert warned(ledger) == {'robot d2'}, 'its map says whose it is'


def test_on_a_shared_topic_nobody_is_to_blame_where_nobody_is_named() -> None:
    ledger = fleet_on_one_topic()
    ledger.refuse('/submaps', 'no message', 11 * S, Sender())
    assert warned(ledger) == {'topic /submaps'}
    ledger.hear(submap_of(0, 2, 1, 0), '/submaps', 1000, 12 * S, Receipt(True))
    assert warned(ledger) == set()
    for name in ('x', 'y'):
        ledger.refuse('/submaps', f'{name}: nonsense', 13 * S, Sender(f'{name}/0', name))
    found = entry(health(ledger), '/node: topic /submaps')
    assert 'x: nonsense; y: nonsense' in found.message
    assert warned(ledger) == {'topic /submaps'}
    for k in range(2 * MAX_SENDERS):
        ledger.refuse('/submaps', 'nonsense', 14 * S, Sender('', f'made up {k}'))
    assert len(ledger.troubles) <= MAX_SENDERS + 1
    ledger.refuse('/submaps', 'nonsense', 15 * S, Sender('', 'd0'))
    assert 'robot d0' in warned(ledger), 'who is known can be told apart from any number'


def test_a_message_that_is_refused_says_who_it_is_from() -> None:
    submap = submap_of(0, 1, 1, 0)
    raw = encode_submap(submap)
    assert sender_of_submap(raw) == ('d1/0', 'd1')
    message = deserialise(raw, SUBMAP)
    message.a = float('nan')
    spoilt = serialise(message)
    with pytest.raises(InvalidMessage):
        decode_submap(spoilt)
    assert sender_of_submap(spoilt) == ('d1/0', 'd1')
    message.robot_id = 'd\n1'
    assert sender_of_submap(serialise(message)) == ('', '')
    assert sender_of_submap(raw[:40]) == ('', '')


def test_the_node_blames_who_is_named(nodes: list[Any]) -> None:
    node, observer = nodes
    for k in range(2):
        observer.send('/submaps', submap_of(0, k, 1, k * S))
    spin_until(nodes, lambda: node.session.ledger.received == 2, 'two robots')
    message = deserialise(encode_submap(submap_of(0, 1, 2, 9 * S)), SUBMAP)
    message.a = float('nan')
    observer.send('/submaps', serialise(message))
    spin_until(nodes, lambda: node.session.ledger.refused == 1, 'nonsense of one of them')
    assert node.session.ledger.trouble_of('d0') == ''
    assert 'd1/0' in node.session.ledger.trouble_of('d1')


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
