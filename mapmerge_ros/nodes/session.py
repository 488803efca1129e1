# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a fusion node is between `configure` and `cleanup`: an engine, and its ways in and out."""

from __future__ import annotations

import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from mapmerge_msgs.srv import LoadMap, MergeNow, RemoveMap, SaveMap
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from std_srvs.srv import SetBool, Trigger

from mapmerge_ros.fusion import Fusion, FusionEngine
from mapmerge_ros.io import InvalidMessage, decode_submap
from mapmerge_ros.io.sender import sender_of_submap
from mapmerge_ros.io.typestore import typestore
from mapmerge_ros.nodes.answers import Answers
from mapmerge_ros.nodes.cloud import Cloud
from mapmerge_ros.nodes.diagnostics import Health
from mapmerge_ros.nodes.discovery import SubmapTopics
from mapmerge_ros.nodes.ledger import Ledger
from mapmerge_ros.nodes.live_parameters import LiveParameters
from mapmerge_ros.nodes.merge_loop import MergeLoop, Product
from mapmerge_ros.nodes.outgoing import Outgoing
from mapmerge_ros.nodes.outputs import Outputs
from mapmerge_ros.nodes.saving import Saving
from mapmerge_ros.nodes.worker import Result

POLL_S = 1.0
"""How often to look for new topics, and to tell how one is."""

CONFLICT_LOG_S = 10.0
"""Least time between two lines about maps that are news and left out all the same."""

JUMPS = JumpThreshold(min_forward=Duration(seconds=1), min_backward=Duration(nanoseconds=-1))
"""
A recording that starts again, a clock that is replaced by another, the first time of all.

Whatever else moves a clock on by a second is told too, and changes nothing.
"""


EMPTY = Product(Fusion((), (), ()), None, Cloud(b''))
"""The merge of nothing."""


class Session:
    """Sub-maps in, global map out; the engine belongs to the thread that spins the node."""

    def __init__(self, node: Any, parameters: LiveParameters) -> None:
        self._node = node
        self._parameters = parameters
        self._settings = parameters.settings()
        self.ledger = Ledger()
        self.product: Product | None = None
        """The last one that succeeded"""
        self._merged_ns: int | None = None
        self._error = ''
        self._wake = node.create_guard_condition(self._on_wake)
        self.merges = MergeLoop(
            # Revisions rise across restarts too, for those who already know this map.
            FusionEngine(parameters.config(), revision=int(time.time())),
            self._wake.trigger,
            self._on_merge,
        )
        self.topics: SubmapTopics | None = None
        """While active"""
        self._tick: Any = None
        self._outputs = Outputs(node, self._settings.publish_tf)
        self._diagnostics = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._services = self._answer_services()
        # Robots come and go in real time, whatever the clock of the node does.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._poll = node.create_timer(POLL_S, self._on_poll, clock=steady)
        self._jumps = node.get_clock().create_jump_callback(JUMPS, post_callback=self._on_jump)
        typestore()  # takes a quarter of a second, for which the first messages would wait

    @property
    def fusion(self) -> Fusion | None:
        """The last one that succeeded."""
        return None if self.product is None else self.product.fusion

    @property
    def now_ns(self) -> int:
        """Node time."""
        return int(self._node.get_clock().now().nanoseconds)

    @property
    def is_active(self) -> bool:
        """Whether sub-maps are received and merged."""
        return self.topics is not None

    def activate(self) -> None:
        """Listen to robots and merge; what was found before is sent again."""
        self.topics = SubmapTopics(
            self._node, self._settings, self.receive, self._outputs.own_topics
        )
        self._tick = self._node.create_timer(self._settings.merge_period, self._on_tick)
        self.topics.poll()
        if self.product is not None:
            self._publish(self.product)

    def deactivate(self) -> None:
        """Neither listen nor merge nor publish; the maps stay."""
        if self.topics is not None:
            self.topics.destroy()
            self.topics = None
            self._node.destroy_timer(self._tick)
            self._tick = None

    def destroy(self) -> bool:
        """Give everything back; whether no merge was left behind."""
        self.deactivate()
        has_ended = self.merges.close()
        self._jumps.unregister()
        for service in self._services:
            self._node.destroy_service(service)
        self._node.destroy_timer(self._poll)
        self._node.destroy_guard_condition(self._wake)
        self._node.destroy_publisher(self._diagnostics)
        self._outputs.destroy()
        return has_ended

    def reconfigure(self) -> None:
        """Take over parameters that have changed."""
        self._settings = self._parameters.settings()
        config = self._parameters.config()
        if config != self.merges.engine.config:
            self.merges.engine.reconfigure(config)
        period_ns = int(self._settings.merge_period * 1e9)
        if self._tick is not None and self._tick.timer_period_ns != period_ns:
            self._tick.timer_period_ns = period_ns
            self._tick.reset()

    def receive(self, topic: str, raw: bytes) -> None:
        """Take in the bytes of a sub-map; what is wrong is counted and disturbs nothing."""
        self.ledger.count(len(raw))
        log = self._node.get_logger()
        try:
            submap = decode_submap(raw)
        except InvalidMessage as err:
            if self.ledger.refuse(topic, str(err), self.now_ns, sender_of_submap(raw)):
                log.warning(f'refused: {topic}: {err}')
            return
        receipt = self.merges.engine.add(submap)
        self.ledger.hear(submap, topic, len(raw), self.now_ns, receipt)
        if receipt.conflict:
            log.warning(
                f'left out: {topic}: {submap.map_id}: {receipt.reason}',
                throttle_duration_sec=CONFLICT_LOG_S,
            )
        elif not receipt.accepted:
            log.debug(f'ignored: {submap.map_id}: {receipt.reason}')
        elif receipt.restarted:
            log.info(f'{submap.map_id} begins again with revision {submap.revision}')

    def _answer_services(self) -> list[Any]:
        answers = Answers(
            self.merges, self.ledger, self._outgoing, lambda: self.is_active, self._on_reset
        )
        saving = Saving(self.merges.engine, self.ledger, lambda: self.now_ns)
        make = self._node.create_service
        # While it waits for its merge, all other callbacks have to go on.
        apart = ReentrantCallbackGroup()
        return [
            make(MergeNow, '~/merge_now', answers.merge_now, callback_group=apart),
            make(RemoveMap, '~/remove', answers.remove),
            make(Trigger, '~/reset', answers.reset),
            make(SetBool, '~/pause', answers.pause),
            make(SaveMap, '~/save_map', saving.save_map),
            make(LoadMap, '~/load_map', saving.load_map),
        ]

    def _on_tick(self) -> None:
        self.merges.tick()
        self._ask()

    def _on_wake(self) -> None:
        self.merges.finish()

    def _on_jump(self, jump: Any) -> None:
        now_ns = self.now_ns
        # Until its first time a clock stands at 0.
        is_first = now_ns - jump.delta.nanoseconds <= 0
        if is_first:
            self.ledger.begin(now_ns)
        self.ledger.rewind(now_ns)
        if self._merged_ns is not None:
            self._merged_ns = now_ns if is_first else min(self._merged_ns, now_ns)

    def _on_merge(self, result: Result[Product]) -> None:
        self._error = result.error
        if result.product is None:
            self._node.get_logger().error(f'merge failed: {result.error}\n{result.trace}')
            return
        self.product, self._merged_ns = result.product, self.now_ns
        if self.is_active:
            self._publish(result.product)
            self._ask()

    def _on_reset(self) -> None:
        """Nobody shall hear any more of what was forgotten, paused or inactive as one may be."""
        if self.product is not None:
            self.product = EMPTY
            self._publish(EMPTY)

    def _ask(self) -> None:
        """Send the requests whose time has come."""
        now_ns = self.now_ns
        for request in self.merges.engine.asking.due(now_ns):
            self._outputs.ask(request, now_ns)
            self.ledger.requests += 1
            count = len(request.landmark_ids)
            self._node.get_logger().info(f'asked {request.map_id} for {count} landmarks')

    def _publish(self, product: Product) -> None:
        outgoing, limit = self._outgoing(product.fusion), self._settings.max_ellipsoids
        status = self._outputs.publish(product, outgoing, self.ledger, limit)
        self._node.get_logger().info(
            f'merged {status.merged} of {status.sub_maps} sub-maps in {status.total_s:.2f} s, '
            f'{status.landmarks} landmarks, p = {status.p_value:.2g}'
        )

    def _outgoing(self, fusion: Fusion | None) -> Outgoing:
        known = fusion or self.fusion or Fusion((), (), ())
        stamp = self._node.get_clock().now().to_msg()
        return Outgoing(known, stamp, self.merges.engine.config)

    def _on_poll(self) -> None:
        if self.topics is not None:
            self.topics.poll()
            self.ledger.see(self.topics.served, self.now_ns)
        health = Health(
            name=self._node.get_fully_qualified_name(),
            now_ns=self.now_ns,
            ledger=self.ledger,
            fusion=self.fusion,
            merged_ns=self._merged_ns,
            error=self._error,
            incompatible=self.topics.incompatible if self.topics else (),
            unanswered=self.merges.engine.asking.unanswered,
            given_up=self.merges.engine.asking.given_up,
            robot_timeout_s=self._settings.robot_timeout,
            mode=self._mode,
            merging_s=self.merges.running_s,
        )
        self._diagnostics.publish(health.message(self._node.get_clock().now().to_msg()))

    @property
    def _mode(self) -> str:
        if not self.is_active:
            return 'inactive'
        return 'paused' if self.merges.paused else 'active'
