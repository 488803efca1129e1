# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Node that plays one robot of a recording: its sub-maps, when it sent them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mapmerge_msgs.msg import SubMap
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.io import encode_submap, read_submaps
from mapmerge_ros.nodes.process import run_node
from mapmerge_ros.nodes.quality import Quality
from mapmerge_ros.nodes.settings import Setting, declare

SETTINGS = (
    Setting('recording', '', 'Path of a .mcap file or a rosbag2 folder.'),
    Setting('robot_id', '', 'Which robot to play; may be empty if there is only one.'),
    Setting('rate', 1.0, 'Times the speed of the recording; 0: all at once.', 0.0, 1e6),
)


@dataclass(frozen=True, slots=True)
class Sending:
    """A message of the recording."""

    at_ns: int
    """Since the start of the recording"""
    topic: str
    raw: bytes


def sendings(recording: str, robot_id: str) -> list[Sending]:
    """
    Messages of one robot, in time order.

    Raises
    ------
    BagError
        The recording cannot be read.
    InvalidValue
        It has no such robot, or several and none was named.

    """
    if not recording:
        raise InvalidValue('recording: empty; set it with -p recording:=FILE')
    recorded = list(read_submaps(recording))
    valid = [(item, item.submap) for item in recorded if item.submap is not None]
    robots = sorted({submap.robot_id for _, submap in valid})
    wanted = robot_id or (robots[0] if len(robots) == 1 else '')
    if wanted not in robots:
        raise InvalidValue(f'robot_id: {robot_id!r} is none of {", ".join(robots)}')
    start_ns = recorded[0].log_time_ns
    return [
        Sending(item.log_time_ns - start_ns, item.topic, encode_submap(submap))
        for item, submap in valid
        if submap.robot_id == wanted
    ]


class RobotNode(Node):  # type: ignore[misc]
    """Publishes what a robot has recorded, and stays for those who come late."""

    def __init__(self, **options: Any) -> None:
        super().__init__('robot_node', **options)
        recording, robot_id, rate = (declare(self, setting) for setting in SETTINGS)
        self._left = sendings(recording, robot_id)
        self._rate = rate
        topics = [sending.topic for sending in self._left]
        self._submaps = {
            # Deep enough that a late subscriber gets all of it.
            topic: self.create_publisher(SubMap, topic, Quality().profile(topics.count(topic)))
            for topic in sorted(set(topics))
        }
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._start_ns = self._clock.now().nanoseconds
        self._timer = self.create_timer(1e-3, self._on_timer, clock=self._clock)

    def close(self) -> None:
        """Nothing runs on after the node."""

    def _on_timer(self) -> None:
        while self._left and self._wait_ns(self._left[0]) <= 0:
            sending = self._left.pop(0)
            self._submaps[sending.topic].publish(sending.raw)
            self.get_logger().info(f'sent {len(sending.raw)} bytes on {sending.topic}')
        if not self._left:
            self._timer.cancel()
            return
        self._timer.timer_period_ns = self._wait_ns(self._left[0])
        self._timer.reset()

    def _wait_ns(self, sending: Sending) -> int:
        if not self._rate:
            return 0
        passed_ns = self._clock.now().nanoseconds - self._start_ns
        return int(sending.at_ns / self._rate) - int(passed_ns)


def main(args: Sequence[str] | None = None) -> int:
    """Play the robot until it is stopped."""
    return run_node(RobotNode, args, SETTINGS)


if __name__ == '__main__':
    raise SystemExit(main())
