# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which quality of service to demand: the best that every publisher of a topic offers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from mapmerge_ros.nodes.parameters import NodeSettings


@dataclass(frozen=True, slots=True)
class Quality:
    """What a publisher offers, or a subscriber demands."""

    reliable: bool = True
    latched: bool = True

    @classmethod
    def offered_by(cls, publisher: Any) -> Quality:
        """Quality that a publisher (of the ROS graph) offers."""
        profile = publisher.qos_profile
        return cls(
            profile.reliability != ReliabilityPolicy.BEST_EFFORT,
            profile.durability != DurabilityPolicy.VOLATILE,
        )

    def missing_from(self, offer: Quality) -> str:
        """Return what this demand misses in an offer; empty when they get together."""
        missing = []
        if self.reliable and not offer.reliable:
            missing.append('best_effort instead of reliable')
        if self.latched and not offer.latched:
            missing.append('volatile instead of transient_local')
        return ' and '.join(missing)

    def profile(self, depth: int) -> Any:
        """Profile of a subscription."""
        reliability, durability = ReliabilityPolicy, DurabilityPolicy
        return QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=depth,
            reliability=reliability.RELIABLE if self.reliable else reliability.BEST_EFFORT,
            durability=durability.TRANSIENT_LOCAL if self.latched else durability.VOLATILE,
        )


LATCHED_PROFILE = Quality().profile(depth=1)
"""Of what the node publishes: whoever comes late gets the latest."""


REQUESTS_PROFILE = Quality().profile(depth=1000)
"""
Of requests: whoever comes late gets what it was asked for, as far back as memory may reach.

Keep-all would grow without end for latecomers; a request has 2.5 kB, and is about one sub-map.
"""


BUNDLE_PROFILE = Quality(latched=False).profile(depth=10)
"""Of bundles that are not latched; a SLAM may send several maps in a row."""


def common(offers: Iterable[Quality]) -> Quality:
    """Return the best that all of these offer."""
    offers = tuple(offers)
    return Quality(all(x.reliable for x in offers), all(x.latched for x in offers))


def demand(offers: Iterable[Quality], settings: NodeSettings) -> Quality:
    """
    Quality to demand of publishers that offer these.

    A volatile subscriber would not get what a robot sent before it was there, one that demands
    more than a publisher offers would get nothing at all.
    """
    best = common(offers)
    reliable, latched = best.reliable, best.latched
    if settings.reliability != 'auto':
        reliable = settings.reliability == 'reliable'
    if settings.durability != 'auto':
        latched = settings.durability == 'transient_local'
    return Quality(reliable, latched)
