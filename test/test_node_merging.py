# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Merges apart from the thread that receives: messages go on, a bug is seen."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest
from ros_processes import MergeNow, Observer, spin_for, spin_until

from mapmerge_ros.fusion import Fusion, FusionConfig, Snapshot, fuse
from mapmerge_ros.nodes import merge_loop
from mapmerge_ros.nodes.worker import Worker
from mapmerge_ros.submap import SubMap


class Gate:
    """A merge that waits until it is let go on."""

    def __init__(self) -> None:
        self.entered = threading.Event()
        self.opened = threading.Event()
        self.calls = 0

    def __call__(self, snapshot: Snapshot, config: FusionConfig, memory: Any) -> Fusion:
        self.calls += 1
        self.entered.set()
        assert self.opened.wait(30)
        return fuse(snapshot, config, memory)


def test_messages_are_received_during_a_merge(
    observer: Observer,
    fusion_node: Callable[..., Any],
    drones: tuple[SubMap, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gate = Gate()
    monkeypatch.setattr(merge_loop, 'fuse', gate)
    node = fusion_node(merge_period=0.05)
    nodes = [node, observer]
    observer.send('/submaps', drones[0])
    spin_until(nodes, gate.entered.is_set, 'the merge begins')
    for submap in drones[1:]:
        observer.send('/submaps', submap)
    spin_until(
        nodes, lambda: node.session.ledger.received == len(drones), 'messages during the merge'
    )
    spin_for(nodes, 0.3)
    assert gate.calls == 1
    assert node.session.fusion is None
    gate.opened.set()
    spin_until(nodes, lambda: observer.merged == len(drones), 'the next merge has them')
    assert gate.calls == 2


def test_a_failing_merge_is_seen_and_the_last_good_map_stays(
    nodes: list[Any], drones: tuple[SubMap, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    node, observer = nodes
    for submap in drones[:2]:
        observer.send('/submaps', submap)
    spin_until(nodes, lambda: node.session.ledger.received == 2, 'two maps')
    assert observer.merge_now(nodes).result == 0
    spin_until(nodes, lambda: observer.heard.is_complete, 'the good map')
    first = observer.heard.status.revision

    def fail(snapshot: Snapshot, config: FusionConfig, memory: Any) -> Fusion:
        raise ZeroDivisionError('a bug')

    with monkeypatch.context() as patch:
        patch.setattr(merge_loop, 'fuse', fail)
        response = observer.merge_now(nodes)
    assert response.result == MergeNow.Response.RESULT_MERGE_FAILED
    assert response.message == 'ZeroDivisionError: a bug'
    spin_until(
        nodes,
        lambda: observer.diagnostics.get('/fusion_node: fusion', (b'',))[0] == b'\2',
        'an error in the diagnostics',
    )
    assert observer.heard.status.revision == first
    assert observer.merge_now(nodes).result == 0
    spin_until(nodes, lambda: observer.heard.status.revision == first + 2, 'and it goes on')


def test_the_worker_runs_one_merge_at_a_time() -> None:
    gate, woken = threading.Event(), threading.Event()

    def merge(snapshot: Snapshot) -> int:
        assert gate.wait(10)
        return len(snapshot.submaps)

    worker = Worker(merge, woken.set)
    worker.start(Snapshot(()))
    assert worker.busy
    assert worker.take() is None
    with pytest.raises(RuntimeError):
        worker.start(Snapshot(()))
    gate.set()
    assert woken.wait(10)
    result = worker.take()
    assert result is not None
    assert (result.product, result.error) == (0, '')
    assert not worker.busy


def test_a_closed_worker_wakes_nobody() -> None:
    gate, woken = threading.Event(), threading.Event()
    worker = Worker(lambda snapshot: gate.wait(10), woken.set)
    worker.start(Snapshot(()))
    assert not worker.close(timeout_s=0.05)
    gate.set()
    assert worker.close(timeout_s=10)
    assert not woken.is_set()
