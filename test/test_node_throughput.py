# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What lets a node keep up with many robots; its benchmark runs. No times are asserted."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from ros_processes import spin_until
from threadpoolctl import threadpool_info, threadpool_limits

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.io import encode_submap
from mapmerge_ros.nodes.discovery import BURST
from mapmerge_ros.nodes.process import run_node
from mapmerge_ros.submap import Source

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))

from messages_184kb import next_revision, submap
from node_throughput import Load, Stamped, run


def blas_threads() -> list[int]:
    found = threadpool_info()
    return [library['num_threads'] for library in found if library['user_api'] == 'blas']


def test_a_node_computes_with_one_blas_thread(capfd: pytest.CaptureFixture[str]) -> None:
    seen = []

    def make() -> Any:
        seen.extend(blas_threads())
        raise MapMergeError('seen enough')

    with threadpool_limits(2):
        before = blas_threads()
        assert run_node(make, []) == 1
        assert blas_threads() == before
    assert 'seen enough' in capfd.readouterr().err
    assert seen == [1] * len(before)


def test_a_burst_of_one_robot_is_received_whole_and_in_order(nodes: list[Any]) -> None:
    node, observer = nodes
    count, known, topic = 3 * BURST // 2, submap(0, 0), '/drone0/submap'
    observer.send(topic, known)
    ledger = node.session.ledger
    spin_until(nodes, lambda: ledger.received == 1, 'the first message')
    for _ in range(count):
        known = next_revision(known)
        observer.send(topic, known)
    spin_until(nodes, lambda: ledger.received == 1 + count, 'the burst')
    assert (ledger.refused, ledger.ignored) == (0, 0)  # none was older than its predecessor
    assert ledger.maps[known.map_id].revision == known.revision


def test_a_stamped_message_is_the_one_of_that_revision() -> None:
    first = submap(3, 0)
    second = replace(first, revision=7, sources=(Source(first.map_id, 7),))
    assert Stamped(first).at(7) == encode_submap(second)


def test_the_benchmark_loses_nothing_at_a_low_rate() -> None:
    found = run(Load(rate_hz=40.0, messages=40, robots=4))
    assert (found.received, found.stored, found.merges) == (40, 40, 0)
    assert found.row.count('|') == 9
