# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Real nodes for tests: processes of their own, or spun beside each other in this one."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

REMEDY = 'real topics need ROS: pip install .[ros] ./msg_schemas'
rclpy = pytest.importorskip('rclpy', reason=REMEDY)
pytest.importorskip('mapmerge_msgs.msg', reason=REMEDY)

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from mapmerge_msgs.msg import AlignmentArray, FusionStatus  # noqa: E402
from mapmerge_msgs.msg import SubMap as SubMapMessage  # noqa: E402
from mapmerge_msgs.srv import MergeNow  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402

from mapmerge_ros.cli.demo_live import Heard  # noqa: E402
from mapmerge_ros.cli.processes import local_environment  # noqa: E402
from mapmerge_ros.io import encode_submap, read_submaps, write_submaps  # noqa: E402
from mapmerge_ros.nodes.quality import LATCHED_PROFILE  # noqa: E402
from mapmerge_ros.submap import SubMap  # noqa: E402

SHIPPED = Path(__file__).resolve().parents[1] / 'bags' / 'four_drones.mcap'

PATIENCE_S = 60.0
"""For a condition that normally holds within two seconds; a busy machine may take its time."""

RETRY_S = 5.0
"""Before a service is called once more."""

FUSION = 'mapmerge_ros.nodes.fusion_node'
ROBOT = 'mapmerge_ros.nodes.robot_node'
COMPRESSOR = 'mapmerge_ros.nodes.compressor_node'
RECORDER = 'mapmerge_ros.nodes.record_node'


def make_recording(folder: Path) -> Path:
    """The shipped recording of four drones; a simulated one where it has not been made."""
    if SHIPPED.exists():
        return SHIPPED
    pytest.importorskip('pycolmap', reason=f'no {SHIPPED}, and pycolmap is missing to simulate it')
    from mapmerge_ros.simulation import FleetConfig, simulate_fleet

    submaps = simulate_fleet(FleetConfig(drones=4, landmarks=120), seed=3).submaps()
    rows = [(f'/{x.robot_id}/submap', x.stamp_ns, x) for x in submaps]
    write_submaps(folder / 'drones.mcap', rows)
    return folder / 'drones.mcap'


def load(recording: Path) -> tuple[SubMap, ...]:
    found = (item.submap for item in read_submaps(recording))
    return tuple(submap for submap in found if submap is not None)


class Observer(Node):
    """Hears a fusion node and its diagnostics, sends sub-maps, calls services."""

    def __init__(self, fusion_node: str = '/fusion_node', name: str = 'observer') -> None:
        super().__init__(name)
        self.heard = heard = Heard()
        for kind, topic, take in (
            (AlignmentArray, 'alignments', heard.take_alignments),
            (FusionStatus, 'status', heard.take_status),
        ):
            self.create_subscription(kind, f'{fusion_node}/{topic}', take, LATCHED_PROFILE)
        self.create_subscription(
            SubMapMessage, f'{fusion_node}/global_map', heard.take_map, LATCHED_PROFILE, raw=True
        )
        self._fusion_node = fusion_node
        self._senders: dict[tuple[str, bool, bool], Any] = {}
        self.diagnostics: dict[str, tuple[bytes, str, dict[str, str]]] = {}
        """Name to level, message and values"""
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)

    @property
    def merged(self) -> int:
        """Sub-maps in the last merge of which all messages are here."""
        return int(self.heard.status.merged) if self.heard.is_complete else 0

    @property
    def node_values(self) -> dict[str, str]:
        return self.diagnostics.get(f'{self._fusion_node}: fusion', (b'', '', {}))[2]

    def send(
        self, topic: str, submap: SubMap | bytes, *, reliable: bool = True, latched: bool = True
    ) -> None:
        key = (topic, reliable, latched)
        if key not in self._senders:
            reliability, durability = ReliabilityPolicy, DurabilityPolicy
            profile = QoSProfile(
                depth=50,
                reliability=reliability.RELIABLE if reliable else reliability.BEST_EFFORT,
                durability=durability.TRANSIENT_LOCAL if latched else durability.VOLATILE,
            )
            self._senders[key] = self.create_publisher(SubMapMessage, topic, profile)
        raw = submap if isinstance(submap, bytes) else encode_submap(submap)
        self._senders[key].publish(raw)

    def latest(self, kind: Any, topic: str) -> dict[str, Any]:
        """Return what will hold the newest message of a latched topic, as `message`."""
        heard: dict[str, Any] = {}
        self.create_subscription(
            kind, topic, lambda message: heard.update(message=message), LATCHED_PROFILE
        )
        return heard

    def leave(self, topic: str) -> None:
        """End the publishers of a topic, as a robot that goes."""
        for key in [key for key in self._senders if key[0] == topic]:
            self.destroy_publisher(self._senders.pop(key))

    def heard_by(self, topic: str) -> int:
        return sum(
            sender.get_subscription_count()
            for (name, _, _), sender in self._senders.items()
            if name == topic
        )

    def call(
        self, service: type[Any], name: str, others: Sequence[Any] = (), **fields: Any
    ) -> Any:
        client = self.create_client(service, f'{self._fusion_node}/{name}')
        nodes = [self, *others]
        spin_until(nodes, client.service_is_ready, f'service {name}')
        # An answer may be lost where a node has just come, or a dead one is still believed in.
        futures: list[Any] = []
        asked_s = -RETRY_S

        def answered() -> Any:
            nonlocal asked_s
            if time.monotonic() - asked_s >= RETRY_S:
                asked_s = time.monotonic()
                futures.append(client.call_async(service.Request(**fields)))
            return next((future for future in futures if future.done()), None)

        spin_until(nodes, answered, f'answer of {name}')
        answer = answered()
        self.destroy_client(client)
        return answer.result()

    def merge_now(self, others: Sequence[Any] = ()) -> Any:
        """Ask for a merge; the answer of the service."""
        return self.call(MergeNow, 'merge_now', others)

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            self.diagnostics[status.name] = (status.level, status.message, values)


@contextmanager
def observing(domain: int, fusion_node_name: str = '/fusion_node') -> Iterator[Observer]:
    """ROS in this process, in a domain that only this machine sees."""
    os.environ.update(local_environment(domain))
    rclpy.init(
        args=['--ros-args', '--disable-external-lib-logs'],
        signal_handler_options=SignalHandlerOptions.NO,
    )
    observer = Observer(fusion_node_name)
    try:
        yield observer
    finally:
        observer.destroy_node()
        rclpy.try_shutdown()


def spin_until(nodes: Sequence[Any], condition: Callable[[], Any], what: str) -> None:
    """Spin nodes of this process until a condition holds; the test fails if it never does."""
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, f'waited in vain: {what}'
        executor.spin_once(timeout_sec=0.02)
    for node in nodes:
        executor.remove_node(node)
    executor.shutdown()


def spin_for(nodes: Sequence[Any], seconds: float) -> None:
    """Only to show that something does not happen."""
    end_s = time.monotonic() + seconds
    spin_until(nodes, lambda: time.monotonic() > end_s, 'the end')
