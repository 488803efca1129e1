# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a robot gets back from the fusion, published: its path and its landmarks."""

from __future__ import annotations

from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseStamped
from nav_msgs.msg import Path
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from mapmerge_ros.io import NamedBundle
from mapmerge_ros.nodes.cloud import Cloud, pack
from mapmerge_ros.nodes.frames import point, quaternion
from mapmerge_ros.nodes.quality import LATCHED_PROFILE
from mapmerge_ros.nodes.way_back import Corrected

WHITE = 0x00FFFFFF


class Corrections:
    """The newest correction of each map of a robot, on two latched topics."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._path = node.create_publisher(Path, 'path', LATCHED_PROFILE)
        self._landmarks = node.create_publisher(PointCloud2, 'landmarks', LATCHED_PROFILE)
        self._known: dict[str, tuple[NamedBundle, Corrected]] = {}

    def publish(self, named: NamedBundle, corrected: Corrected) -> None:
        """Send path and landmarks of the whole robot, in the global frame."""
        self._known[corrected.map_id] = named, corrected
        stamp = self._node.get_clock().now().to_msg()
        header = Header(stamp=stamp, frame_id=corrected.global_frame)
        poses = [
            pose
            for _, pair in sorted(self._known.items())
            for pose in _poses(*pair)
            if pair[1].global_frame == corrected.global_frame
        ]
        poses.sort(key=lambda pose: (pose.header.stamp.sec, pose.header.stamp.nanosec))
        self._path.publish(Path(header=header, poses=poses))
        self._landmarks.publish(self._cloud().message(header))

    def _cloud(self) -> Cloud:
        parts = [corrected.points_global for _, (_, corrected) in sorted(self._known.items())]
        return pack(np.concatenate(parts), WHITE, np.nan, 1)


def _poses(named: NamedBundle, corrected: Corrected) -> list[Any]:
    """A PoseStamped of each key frame's optical frame."""
    return [
        PoseStamped(
            header=Header(stamp=_time(stamp_ns), frame_id=corrected.global_frame),
            pose=Pose(position=point(position), orientation=quaternion(rotation)),
        )
        for stamp_ns, position, rotation in zip(
            named.keyframe_stamps_ns,
            corrected.positions_global,
            corrected.rotations_global_camera,
            strict=True,
        )
    ]


def _time(stamp_ns: int) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)
