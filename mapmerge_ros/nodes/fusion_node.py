# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Node that merges the sub-maps of a fleet as they come, and says whether to believe it."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from mapmerge_msgs.msg import AlignmentArray, FusionStatus, LandmarkRequest, SubMap
from mapmerge_msgs.srv import MergeNow, RemoveMap
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_srvs.srv import Trigger

from mapmerge_ros.fusion import Fusion, FusionEngine
from mapmerge_ros.io import InvalidMessage, decode_submap, encode_request
from mapmerge_ros.nodes.answers import Answers
from mapmerge_ros.nodes.diagnostics import Health
from mapmerge_ros.nodes.discovery import SubmapTopics
from mapmerge_ros.nodes.ledger import Ledger
from mapmerge_ros.nodes.merge_loop import MergeLoop, Product
from mapmerge_ros.nodes.outgoing import Outgoing
from mapmerge_ros.nodes.parameters import declare_config, declare_settings
from mapmerge_ros.nodes.process import run_node
from mapmerge_ros.nodes.quality import LATCHED_PROFILE, REQUESTS_PROFILE
from mapmerge_ros.nodes.worker import Result

POLL_S = 1.0
"""How often to look for new topics, and to tell how one is."""


class FusionNode(Node):  # type: ignore[misc]
    """Sub-maps in, global map out; the engine belongs to the thread that spins this node."""

    def __init__(self, **options: Any) -> None:
        super().__init__('fusion_node', **options)
        settings, config = declare_settings(self), declare_config(self)
        self.ledger = Ledger()
        self.fusion: Fusion | None = None
        """The last one that succeeded"""
        self._merged_ns: int | None = None
        self._error = ''
        wake = self.create_guard_condition(self._on_wake)
        self.merges = MergeLoop(
            # Revisions rise across restarts too, for those who already know this map.
            FusionEngine(config, revision=int(time.time())),
            wake.trigger,
            self._on_merge,
        )
        self._global_map = self.create_publisher(SubMap, '~/global_map', LATCHED_PROFILE)
        self._alignments = self.create_publisher(AlignmentArray, '~/alignments', LATCHED_PROFILE)
        self._requests = self.create_publisher(LandmarkRequest, '~/requests', REQUESTS_PROFILE)
        self._status = self.create_publisher(FusionStatus, '~/status', LATCHED_PROFILE)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        own_topics = frozenset({self._global_map.topic_name})
        self.topics = SubmapTopics(self, settings, self._on_submap, own_topics)
        self._answer_services()
        self.create_timer(settings.merge_period, self._on_tick)
        # Robots come and go in real time, whatever the clock of the node does.
        self.create_timer(POLL_S, self._on_poll, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.topics.poll()

    def close(self) -> None:
        """End the worker; a merge that does not end is left behind."""
        if not self.merges.close():
            # The logger is gone with the context.
            print('ended during a merge, which is lost', file=sys.stderr)

    @property
    def now_ns(self) -> int:
        """Node time."""
        return int(self.get_clock().now().nanoseconds)

    def _answer_services(self) -> None:
        answers = Answers(self.merges, self.ledger, self._outgoing)
        # While it waits for its merge, all other callbacks have to go on.
        apart = ReentrantCallbackGroup()
        self.create_service(MergeNow, '~/merge_now', answers.merge_now, callback_group=apart)
        self.create_service(RemoveMap, '~/remove', answers.remove)
        self.create_service(Trigger, '~/reset', answers.reset)

    def _on_submap(self, raw: bytes) -> None:
        self.ledger.count(len(raw))
        try:
            submap = decode_submap(raw)
        except InvalidMessage as err:
            if self.ledger.refuse(str(err), self.now_ns):
                self.get_logger().warning(f'refused: {err}')
            return
        receipt = self.merges.engine.add(submap)
        self.ledger.hear(submap, len(raw), self.now_ns, accepted=receipt.accepted)
        if not receipt.accepted:
            self.get_logger().debug(f'ignored: {submap.map_id}: {receipt.reason}')

    def _on_tick(self) -> None:
        self.merges.tick()
        self._ask()

    def _on_wake(self) -> None:
        self.merges.finish()

    def _on_merge(self, result: Result[Product]) -> None:
        self._error = result.error
        if result.product is None:
            self.get_logger().error(f'merge failed: {result.error}\n{result.trace}')
            return
        self.fusion, self._merged_ns = result.product.fusion, self.now_ns
        self._publish(result.product)
        self._ask()

    def _ask(self) -> None:
        """Send the requests whose time has come."""
        now_ns = self.now_ns
        for request in self.merges.engine.asking.due(now_ns):
            self._requests.publish(encode_request(request, now_ns))
            self.ledger.requests += 1
            count = len(request.landmark_ids)
            self.get_logger().info(f'asked {request.map_id} for {count} landmarks')

    def _publish(self, product: Product) -> None:
        outgoing = self._outgoing(product.fusion)
        if product.global_map is not None:
            self._global_map.publish(product.global_map)
            self.ledger.bytes_out += len(product.global_map)
        self._alignments.publish(outgoing.alignments())
        status = outgoing.status(self.ledger)
        self._status.publish(status)
        self.get_logger().info(
            f'merged {status.merged} of {status.sub_maps} sub-maps in {status.total_s:.2f} s, '
            f'{status.landmarks} landmarks, p = {status.p_value:.2g}'
        )

    def _outgoing(self, fusion: Fusion | None) -> Outgoing:
        known = fusion or self.fusion or Fusion((), (), ())
        return Outgoing(known, self.get_clock().now().to_msg(), self.merges.engine.config)

    def _on_poll(self) -> None:
        self.topics.poll()
        health = Health(
            name=self.get_fully_qualified_name(),
            now_ns=self.now_ns,
            ledger=self.ledger,
            fusion=self.fusion,
            merged_ns=self._merged_ns,
            error=self._error,
            incompatible=self.topics.incompatible,
            unanswered=self.merges.engine.asking.unanswered,
            given_up=self.merges.engine.asking.given_up,
        )
        self._diagnostics.publish(health.message(self.get_clock().now().to_msg()))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is stopped."""
    return run_node(FusionNode, args)


if __name__ == '__main__':
    raise SystemExit(main())
