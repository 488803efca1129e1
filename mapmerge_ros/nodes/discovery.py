# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Topics of sub-maps, subscribed to as they appear."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from mapmerge_msgs.msg import SubMap
from rclpy.event_handler import SubscriptionEventCallbacks

from mapmerge_ros.io.typestore import SUBMAP
from mapmerge_ros.nodes.parameters import NodeSettings
from mapmerge_ros.nodes.quality import Quality, demand

Receive = Callable[[str, bytes], None]
"""Takes the topic, and a serialised message."""

BURST = 32
"""
Messages of one topic that are received in one turn of the executor, a few milliseconds.

A turn costs as much as a message, and while a merge runs in the other thread it may have to wait
5 ms for the interpreter.
"""


@dataclass(frozen=True, slots=True, eq=False)
class _Subscribed:
    subscription: Any
    quality: Quality


class SubmapTopics:
    """
    Subscriptions to `submaps` and to every topic of type SubMap with a matching name.

    Messages come as bytes: a recording and a robot go through the same decoder.
    """

    def __init__(
        self, node: Any, settings: NodeSettings, receive: Receive, own_topics: frozenset[str]
    ) -> None:
        self._node = node
        self._settings = settings
        self._receive = receive
        self._own_topics = own_topics
        self._subscribed: dict[str, _Subscribed] = {}
        self._warned: set[str] = set()
        self.incompatible: tuple[str, ...] = ()
        """Publishers that cannot reach us, and why"""
        self.served: frozenset[str] = frozenset()
        """Topics that somebody publishes on"""
        self._subscribe(node.resolve_topic_name('submaps'))

    def poll(self) -> None:
        """Look for topics and publishers that have come or gone."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self._own_topics or not self._is_wanted(topic):
                continue
            others = sorted(set(types) - {SUBMAP})
            if others:
                self._warn(f'{topic}: of type {", ".join(others)}, expected {SUBMAP}')
            if SUBMAP in types and topic not in self._subscribed:
                self._subscribe(topic)
        self.incompatible = tuple(
            line for topic in tuple(self._subscribed) for line in self._adapt(topic)
        )
        self.served = frozenset(topic for topic in self._subscribed if self._publishers(topic))
        for line in self.incompatible:
            self._warn(f'{line}: none of its messages arrive')

    def destroy(self) -> None:
        """End all subscriptions."""
        for subscribed in self._subscribed.values():
            self._node.destroy_subscription(subscribed.subscription)
        self._subscribed.clear()

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics that are subscribed to."""
        return tuple(sorted(self._subscribed))

    def _is_wanted(self, topic: str) -> bool:
        pattern = self._settings.discovery_pattern
        return topic in self._subscribed or pattern.fullmatch(topic) is not None

    def _subscribe(self, topic: str) -> None:
        offers = [Quality.offered_by(publisher) for publisher in self._publishers(topic)]
        quality = demand(offers, self._settings)
        subscription = self._node.create_subscription(
            SubMap,
            topic,
            partial(self._take, topic),
            quality.profile(self._settings.depth),
            raw=True,
            # The default one warns without a name; `poll` does it better.
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=lambda _: None),
        )
        self._subscribed[topic] = _Subscribed(subscription, quality)
        self._node.get_logger().info(f'listening to {topic}')

    def _take(self, topic: str, raw: bytes) -> None:
        """Receive a message, and what waits behind it."""
        self._receive(topic, raw)
        if topic in self._subscribed:
            self._drain(topic, self._subscribed[topic].subscription, BURST - 1)

    def _adapt(self, topic: str) -> list[str]:
        """Demand what the publishers of today offer; a line for each that offers less."""
        publishers = self._publishers(topic)
        offers = [Quality.offered_by(publisher) for publisher in publishers]
        old = self._subscribed[topic]
        if offers and demand(offers, self._settings) != old.quality:
            self._subscribe(topic)
            self._drain(topic, old.subscription, self._settings.depth)
            self._node.destroy_subscription(old.subscription)
        quality = self._subscribed[topic].quality
        return [
            f'{_name(publisher)} offers {missing} on {topic}'
            for publisher, offer in zip(publishers, offers, strict=True)
            if (missing := quality.missing_from(offer))
        ]

    def _drain(self, topic: str, subscription: Any, limit: int) -> None:
        """Receive what has arrived, `limit` messages at most."""
        with subscription.handle:
            for _ in range(limit):
                taken = subscription.handle.take_message(SubMap, True)
                if taken is None:
                    return
                self._receive(topic, taken[0])

    def _publishers(self, topic: str) -> list[Any]:
        found = self._node.get_publishers_info_by_topic(topic)
        return [publisher for publisher in found if publisher.topic_type == SUBMAP]

    def _warn(self, line: str) -> None:
        if line not in self._warned:
            self._warned.add(line)
            self._node.get_logger().warning(line)


def _name(publisher: Any) -> str:
    return f'{publisher.node_namespace.rstrip("/")}/{publisher.node_name}'
