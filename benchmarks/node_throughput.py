# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
How many sub-map messages of 184 kB a second the fusion node receives, checks and stores.

    python benchmarks/node_throughput.py

Real processes over DDS, on this machine only: one publisher per robot, all in one process, and
the node as it is shipped. Every message is a new revision, so all of them are stored. Twice: at
high rates without merges, and at 100 messages a second while the maps of a fleet are merged all
the time. The CPU time is that of the node's process; its inverse is the rate that a core can do.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from mapmerge_msgs.msg import SubMap as SubMapMessage
from messages_184kb import LANDMARKS, next_revision, submap
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from workloads import workload

from mapmerge_ros.bundle import Bundle, MapName, compress
from mapmerge_ros.cli.processes import Children, free_domain, local_environment
from mapmerge_ros.io import encode_submap
from mapmerge_ros.submap import SubMap

DEPTH = 50
"""Messages that a publisher keeps until they are acknowledged."""

PATIENCE_S = 30.0
TICK_HZ = os.sysconf('SC_CLK_TCK')


@dataclass(frozen=True)
class Load:
    """What is sent."""

    rate_hz: float
    messages: int
    robots: int = 16
    merge_period_s: float = 3600.0
    """3600: never"""
    fleet: str = ''
    """Workload whose sub-maps are sent; empty: noise of the same size"""


@dataclass(frozen=True)
class Outcome:
    """What became of it."""

    sent: int
    received: int
    stored: int
    sent_s: float
    """Time that the sending took"""
    cpu_s: float
    """Of the node's process"""
    merges: int
    size_bytes: int
    """Of one message"""

    @property
    def row(self) -> str:
        """Line of a table."""
        lost = self.sent - self.received
        per_message_us = self.cpu_s / max(self.received, 1) * 1e6
        return (
            f'| {self.sent / self.sent_s:.0f} | {self.size_bytes / 1e3:.0f} | {self.sent} | '
            f'{self.received} | {self.stored} | {lost} | {self.merges} | {per_message_us:.0f} |'
        )


HEAD = """\
| messages a second | kB each | sent | received | stored | lost | merges | CPU µs a message |
|---|---|---|---|---|---|---|---|"""


class Stamped:
    """The bytes of a sub-map under any revision, without encoding it again."""

    def __init__(self, first: SubMap) -> None:
        one, other = (encode_submap(_at(first, number)) for number in (0, 0xFFFFFFFF))
        places = [k for k in range(len(one)) if one[k] != other[k]]
        self._starts = places[::4]
        self._raw = bytearray(one)

    def at(self, revision: int) -> bytes:
        """Return the message of a revision."""
        for start in self._starts:
            self._raw[start : start + 4] = revision.to_bytes(4, 'little')
        return bytes(self._raw)


def _at(known: SubMap, revision: int) -> SubMap:
    source = replace(known.sources[0], revision=revision)
    return replace(known, revision=revision, sources=(source,))


def maps_of(load: Load) -> list[SubMap]:
    """One sub-map of each robot."""
    if not load.fleet:
        return [next_revision(submap(k, 0)) for k in range(load.robots)]
    fleet = workload(load.fleet, drones=load.robots)
    pairs = zip(fleet.bundles, fleet.submaps, strict=True)
    return [_filled(bundle, known) for bundle, known in pairs]


def _filled(bundle: Bundle, known: SubMap) -> SubMap:
    """The map of a drone with so many of its own landmarks that it has 184 kB."""
    own = np.setdiff1d(bundle.point_ids, known.landmark_ids)
    ids = np.concatenate([known.landmark_ids, own])[:LANDMARKS]
    name = MapName(known.map_id, known.robot_id, stamp_ns=known.stamp_ns, id_space='fleet')
    return compress(bundle, name, ids, catalogue=False)


def publish(load: Load) -> None:
    """Send at a steady rate, once every robot is heard; print how long that took."""
    messages = [Stamped(item) for item in maps_of(load)]
    rclpy.init()
    node = Node('robots')
    profile = QoSProfile(depth=DEPTH, durability=DurabilityPolicy.VOLATILE)
    senders = [
        node.create_publisher(SubMapMessage, f'/drone{k}/submap', profile)
        for k in range(load.robots)
    ]
    while not all(sender.get_subscription_count() for sender in senders):
        time.sleep(0.05)
    time.sleep(2.5)  # the node looks once a second what publishers offer
    begin_s = time.monotonic()
    for number in range(load.messages):
        delay_s = begin_s + number / load.rate_hz - time.monotonic()
        if delay_s > 0.0:
            time.sleep(delay_s)
        robot = number % load.robots
        senders[robot].publish(messages[robot].at(2 + number // load.robots))
    print(time.monotonic() - begin_s, len(messages[0].at(2)), flush=True)
    sys.stdin.readline()  # a publisher that goes takes what it has not delivered with it
    rclpy.shutdown()


class Listener(Node):
    """Hears the diagnostics of the fusion node, and counts its merges."""

    def __init__(self) -> None:
        super().__init__('listener')
        self.values: dict[str, str] = {}
        self.merges = 0
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self.create_subscription(
            SubMapMessage, '/fusion_node/global_map', self._on_map, DEPTH, raw=True
        )

    def count(self, name: str) -> int:
        """Counter of the node; -1 before it was heard."""
        return int(self.values.get(name, -1))

    def _on_map(self, raw: bytes) -> None:
        self.merges += 1

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == '/fusion_node: fusion':
                self.values = {item.key: item.value for item in status.values}


def run(load: Load) -> Outcome:
    """Start a node and robots, and see what arrives."""
    domain = free_domain()
    with tempfile.TemporaryDirectory() as folder, Children(domain, Path(folder)) as children:
        parameters = {'merge_period': load.merge_period_s, 'ask': False}
        node = children.start('node', 'mapmerge_ros.nodes.fusion_node', parameters)
        with listening(domain) as listener, publishing(load, domain) as robots:
            _spin(listener, lambda: listener.count('messages_received') >= 0)
            cpu_s = _cpu_s(node.pid)
            sent_s, size_bytes = _answer(listener, robots)
            _settle(listener)
            received = listener.count('messages_received')
            left_out = listener.count('messages_refused') + listener.count('messages_ignored')
            return Outcome(
                load.messages,
                received,
                received - left_out,
                sent_s,
                _cpu_s(node.pid) - cpu_s,
                listener.merges,
                size_bytes,
            )


@contextmanager
def listening(domain: int) -> Iterator[Listener]:
    """ROS in this process."""
    os.environ.update(local_environment(domain))
    rclpy.init()
    try:
        yield Listener()
    finally:
        rclpy.try_shutdown()


@contextmanager
def publishing(load: Load, domain: int) -> Iterator[subprocess.Popen[str]]:
    """Robots in a process of their own."""
    own = [sys.executable, __file__, '--publish', *map(str, vars(load).values())]
    environment = {**os.environ, **local_environment(domain)}
    with subprocess.Popen(
        own, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _answer(listener: Listener, robots: subprocess.Popen[str]) -> tuple[float, int]:
    """Wait for the robots' last line while merges are heard."""
    assert robots.stdout is not None
    os.set_blocking(robots.stdout.fileno(), False)
    while not (line := robots.stdout.readline()):
        if robots.poll() is not None:
            raise RuntimeError('the robots have ended')
        rclpy.spin_once(listener, timeout_sec=0.1)
    duration_s, size_bytes = line.split()
    return float(duration_s), int(size_bytes)


def _settle(listener: Listener) -> None:
    """Until nothing more arrives for three seconds."""
    last, since_s = -1, time.monotonic()
    while time.monotonic() - since_s < 3.0:
        rclpy.spin_once(listener, timeout_sec=0.1)
        if listener.count('messages_received') != last:
            last, since_s = listener.count('messages_received'), time.monotonic()


def _spin(listener: Listener, condition: object) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():  # type: ignore[operator]
        if time.monotonic() > deadline_s:
            raise RuntimeError('the fusion node is not heard')
        rclpy.spin_once(listener, timeout_sec=0.1)


def _cpu_s(pid: int) -> float:
    """CPU time of a process, user and system."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK_HZ


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--rates', type=float, nargs='+', default=[500.0, 1000.0, 1500.0])
    parser.add_argument('--seconds', type=float, default=8.0, help='of each rate')
    parser.add_argument('--fleet', default='S2', help='workload that is merged all the time')
    parser.add_argument('--merging', type=float, default=20.0, help='seconds of that; 0: not')
    parser.add_argument('--publish', nargs=5, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.publish:
        rate, messages, robots, period, fleet = args.publish
        publish(Load(float(rate), int(messages), int(robots), float(period), fleet))
        return 0
    loads = [Load(rate, round(rate * args.seconds)) for rate in args.rates]
    if args.merging:
        loads.append(Load(100.0, round(100 * args.merging), 16, 0.1, args.fleet))
    print(HEAD)
    for load in loads:
        print(run(load).row, flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
