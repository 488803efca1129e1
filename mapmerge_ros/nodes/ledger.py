# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What has been received: counters of the node, of every robot, and the maps that are held."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapmerge_ros.fusion import Receipt
from mapmerge_ros.io.sender import Sender
from mapmerge_ros.submap import SubMap

MAX_REASONS = 1000
"""Different refusals that are remembered: a broken robot must not fill the memory."""

MAX_SENDERS = 100
"""Senders of messages that failed the checks who are told apart; of more, only the topics."""


@dataclass(frozen=True, slots=True)
class Held:
    """A sub-map that the engine has taken in."""

    robot_id: str
    revision: int
    landmarks: int
    size_bytes: int
    """Of its message"""
    observation_bytes: int
    """What its observations would take, two float32 each"""


@dataclass(slots=True)
class RobotRecord:
    """What one robot has sent."""

    topic: str
    """Where it was heard last"""
    first_ns: int
    last_ns: int
    """Of its messages"""
    seen_ns: int
    """Last message, or last time that somebody was there to publish on its topic"""
    messages: int = 0
    size_bytes: int = 0
    ignored: int = 0
    """Of its messages: no newer than what was there"""
    trouble: str = ''
    """Why its newest message was left out although it is news"""

    def age_s(self, now_ns: int) -> float:
        """Seconds since its last message."""
        return max(now_ns - self.last_ns, 0) * 1e-9

    def absent_s(self, now_ns: int) -> float:
        """Seconds since it was there."""
        return max(now_ns - self.seen_ns, 0) * 1e-9

    def bytes_per_s(self, now_ns: int) -> float:
        """Mean rate since its first message; over a second at least."""
        return self.size_bytes / self._span_s(now_ns)

    def messages_per_s(self, now_ns: int) -> float:
        """Mean rate since its first message; over a second at least."""
        return self.messages / self._span_s(now_ns)

    def _span_s(self, now_ns: int) -> float:
        return max((now_ns - self.first_ns) * 1e-9, 1.0)


@dataclass(slots=True)
class Ledger:
    """Counters since the start of the node; times are node time."""

    received: int = 0
    refused: int = 0
    """Of those received: failed the checks"""
    ignored: int = 0
    """Of those received: no newer than what was there"""
    bytes_in: int = 0
    bytes_out: int = 0
    requests: int = 0
    """Sent to robots, repetitions included"""
    last_refusal: str = ''
    last_refusal_ns: int | None = None
    robots: dict[str, RobotRecord] = field(default_factory=dict)
    maps: dict[str, Held] = field(default_factory=dict)
    """By map_id, those that the engine holds"""
    troubles: dict[tuple[str, str], str] = field(default_factory=dict)
    """By topic and robot_id ('' where none is named), why a newest message failed the checks"""
    _reasons: set[str] = field(default_factory=set)

    def count(self, size_bytes: int) -> None:
        """Count a message before it is looked at."""
        self.received += 1
        self.bytes_in += size_bytes

    def refuse(self, topic: str, reason: str, now_ns: int, sender: Sender | None = None) -> bool:
        """
        Book a message that failed the checks; whether this is new and worth a line.

        `sender` is who it says it is from. Others on the topic are not blamed for it.
        """
        self.refused += 1
        self._blame(topic, self._robot_of(sender), reason)
        reason = f'{topic}: {reason}'
        self.last_refusal, self.last_refusal_ns = reason, now_ns
        if reason in self._reasons or len(self._reasons) >= MAX_REASONS:
            return False
        self._reasons.add(reason)
        return True

    def hear(
        self, submap: SubMap, topic: str, size_bytes: int, now_ns: int, receipt: Receipt
    ) -> None:
        """Book a valid message on its robot, and its map if the engine has taken it in."""
        record = self._record(submap.robot_id, topic, now_ns)
        record.topic, record.last_ns, record.seen_ns = topic, now_ns, now_ns
        record.messages += 1
        record.size_bytes += size_bytes
        self._absolve(topic, submap.robot_id)
        if receipt.accepted:
            record.trouble = ''
            self.hold(submap, size_bytes, now_ns)
            return
        self.ignored += 1
        record.ignored += 1
        if receipt.conflict:
            record.trouble = f'{submap.map_id}: {receipt.reason}'

    def hold(self, submap: SubMap, size_bytes: int, now_ns: int) -> None:
        """Book a map that the engine has taken in, from wherever."""
        self._record(submap.robot_id, '', now_ns)
        self.maps[submap.map_id] = Held(
            robot_id=submap.robot_id,
            revision=submap.revision,
            landmarks=len(submap.landmark_ids),
            size_bytes=size_bytes,
            observation_bytes=4 * submap.residual_count,
        )

    def see(self, topics: frozenset[str], now_ns: int) -> None:
        """Take note of the topics that somebody publishes on now."""
        for record in self.robots.values():
            if record.topic in topics:
                record.seen_ns = now_ns
        self.troubles = {who: why for who, why in self.troubles.items() if who[0] in topics}

    def trouble_of(self, robot_id: str) -> str:
        """Return why the newest message of a robot failed the checks; empty if it did not."""
        found = (why for who, why in self.troubles.items() if self._culprit(*who) == robot_id)
        return next(found, '')

    def nobodys_troubles(self) -> dict[str, str]:
        """By topic, why messages failed the checks whose sender is no robot that is known."""
        found: dict[str, str] = {}
        for (topic, robot_id), why in sorted(self.troubles.items()):
            if not self._culprit(topic, robot_id):
                found[topic] = f'{found[topic]}; {why}' if topic in found else why
        return found

    def rewind(self, now_ns: int) -> None:
        """Follow a clock that was set back: nothing was heard in the future."""
        for record in self.robots.values():
            record.first_ns = min(record.first_ns, now_ns)
            record.last_ns = min(record.last_ns, now_ns)
            record.seen_ns = min(record.seen_ns, now_ns)
        if self.last_refusal_ns is not None:
            self.last_refusal_ns = min(self.last_refusal_ns, now_ns)

    def begin(self, now_ns: int) -> None:
        """Follow a clock that has just got its first time: what came before came now."""
        for record in self.robots.values():
            record.first_ns = record.last_ns = record.seen_ns = now_ns
        if self.last_refusal_ns is not None:
            self.last_refusal_ns = now_ns

    def _robot_of(self, sender: Sender | None) -> str:
        if sender is None:
            return ''
        held = self.maps.get(sender.map_id)
        return sender.robot_id or ('' if held is None else held.robot_id)

    def _blame(self, topic: str, robot_id: str, reason: str) -> None:
        is_known = (topic, robot_id) in self.troubles or robot_id in self.robots
        if not is_known and len(self.troubles) >= MAX_SENDERS:
            robot_id = ''
        self.troubles[topic, robot_id] = reason

    def _absolve(self, topic: str, robot_id: str) -> None:
        """Drop what a good message makes up for: who was not named on its topic may be it."""
        self.troubles = {
            who: why
            for who, why in self.troubles.items()
            if who[1] != robot_id and who != (topic, '')
        }

    def _culprit(self, topic: str, robot_id: str) -> str:
        """Name of a known robot that is to blame; where none is named, the only one there."""
        if robot_id:
            return robot_id if robot_id in self.robots else ''
        there = [name for name, record in self.robots.items() if record.topic == topic]
        return there[0] if len(there) == 1 else ''

    def _record(self, robot_id: str, topic: str, now_ns: int) -> RobotRecord:
        return self.robots.setdefault(robot_id, RobotRecord(topic, now_ns, now_ns, now_ns))

    def matching(self, map_id: str, robot_id: str) -> tuple[str, ...]:
        """Maps of this name and of this robot; an empty name is any."""
        return tuple(
            name
            for name, held in self.maps.items()
            if map_id in ('', name) and robot_id in ('', held.robot_id)
        )

    def forget(self, map_ids: tuple[str, ...]) -> None:
        """Drop maps, and the robots that have none left."""
        for map_id in map_ids:
            self.maps.pop(map_id, None)
        left = {held.robot_id for held in self.maps.values()}
        self.robots = {name: record for name, record in self.robots.items() if name in left}
