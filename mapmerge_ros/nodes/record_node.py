# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Node that writes sub-maps, requests and results to a recording, byte by byte as they come."""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

import mapmerge_msgs.msg
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node

from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.io import record
from mapmerge_ros.nodes.process import run_node
from mapmerge_ros.nodes.quality import Quality, common
from mapmerge_ros.nodes.settings import Setting, declare

SETTINGS = (
    Setting('output', '', 'The .mcap file; it appears when the recording ends.'),
    Setting('pattern', '.*', 'Regular expression of the topics to record.', is_pattern=True),
)

PACKAGE = 'mapmerge_msgs/msg/'

POLL_S = 0.2
"""How often to look for new topics: a volatile message that came before is lost."""

DEPTH = 1000
"""Messages of a topic that may wait; requests keep as many for latecomers."""

REMEMBERED = 100 * DEPTH
"""Messages of a topic that are known again: a hundred publishers may latch as many as may wait."""


class Known:
    """
    Messages of a topic that were written.

    A new subscription is sent again what is latched, with the time of its publication. Who sends
    the same bytes a second time does it at another.
    """

    def __init__(self) -> None:
        self._keys: set[int] = set()
        self._order: deque[int] = deque()

    def is_news(self, raw: bytes, published_ns: int) -> bool:
        """Take note of a message; whether it was not known. Without a time (0) all are news."""
        key = hash((published_ns, raw))
        if published_ns and key in self._keys:
            return False
        self._keys.add(key)
        self._order.append(key)
        if len(self._order) > REMEMBERED:
            self._keys.discard(self._order.popleft())
        return True


class RecordNode(Node):  # type: ignore[misc]
    """Subscribes to every topic of mapmerge_msgs, with the quality that its publishers offer."""

    def __init__(self, **options: Any) -> None:
        super().__init__('mapmerge_recorder', **options)
        output, pattern = (declare(self, setting) for setting in SETTINGS)
        if not output.endswith('.mcap'):
            raise InvalidValue(f'output: {output!r}: give a name that ends in .mcap')
        self._pattern = re.compile(pattern)
        self._subscribed: dict[str, tuple[Any, Quality]] = {}
        self._known: dict[str, Known] = {}
        self._counts: Counter[str] = Counter()
        self._stack = ExitStack()
        self._recorder = self._stack.enter_context(record(output))
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(POLL_S, self._on_poll, clock=steady)
        self._on_poll()

    def close(self) -> None:
        """Write the index; only now the file is there."""
        self._stack.close()
        print(f'{self._counts.total()} messages of {len(self._counts)} topics recorded')

    def _on_poll(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            ours = [name for name in types if name.startswith(PACKAGE)]
            if len(types) == 1 and ours and self._pattern.fullmatch(topic):
                self._adapt(topic, ours[0])

    def _adapt(self, topic: str, typename: str) -> None:
        publishers = self.get_publishers_info_by_topic(topic)
        if not publishers:
            return
        quality = common(Quality.offered_by(publisher) for publisher in publishers)
        old = self._subscribed.get(topic)
        if old is not None and old[1] == quality:
            return
        subscription = self.create_subscription(
            getattr(mapmerge_msgs.msg, typename.removeprefix(PACKAGE)),
            topic,
            partial(self._on_message, topic, typename),
            quality.profile(DEPTH),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=lambda _: None),
        )
        self._subscribed[topic] = subscription, quality
        if old is not None:
            self._drain(topic, typename, old[0])
            self.destroy_subscription(old[0])

    def _drain(self, topic: str, typename: str, subscription: Any) -> None:
        """Write what has arrived and would go with its subscription."""
        handle = subscription.handle
        with handle:
            while (taken := handle.take_message(subscription.msg_type, True)) is not None:
                self._on_message(topic, typename, *taken)

    def _on_message(
        self, topic: str, typename: str, raw: bytes, info: Mapping[str, int | None]
    ) -> None:
        if not self._known.setdefault(topic, Known()).is_news(raw, info['source_timestamp'] or 0):
            return
        now_ns = max(int(self.get_clock().now().nanoseconds), 0)
        self._recorder.write_bytes(topic, now_ns, typename, raw)
        self._counts[topic] += 1
        if self._counts[topic] == 1:
            self.get_logger().info(f'recording {topic}')


def main(args: Sequence[str] | None = None) -> int:
    """Record until it is stopped."""
    return run_node(RecordNode, args, SETTINGS)


if __name__ == '__main__':
    raise SystemExit(main())
