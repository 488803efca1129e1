# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Frames of merged sub-maps below the global frame, for TF (REP 105).

A plain publisher on `/tf_static` does it: the library tf2 is not needed to send transforms, and
its message is the only thing that may be missing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import Point, Quaternion, Transform, TransformStamped, Vector3
from std_msgs.msg import Header

from mapmerge_ros.arrays import Floats
from mapmerge_ros.fusion import Fusion, MapAlignment, State
from mapmerge_ros.geometry.rotations import as_rotation
from mapmerge_ros.nodes.quality import LATCHED_PROFILE

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

MISSING = 'tf2_msgs is not installed: no TF is published, frames are in ~/alignments only'


class FramePublisher:
    """Sends the rigid part of every merged sub-map's frame; the scale is in `~/alignments`."""

    def __init__(self, node: Any, is_wanted: bool) -> None:
        self._node = node
        self._warned: set[str] = set()
        self._publisher = None
        if is_wanted and TFMessage is None:
            node.get_logger().info(MISSING)
        elif is_wanted:
            self._publisher = node.create_publisher(TFMessage, '/tf_static', LATCHED_PROFILE)

    def publish(self, fusion: Fusion, header: Any) -> None:
        """Send the frames of a fusion; one that cannot be sent is named once."""
        if self._publisher is None:
            return
        placed, problems = placeable(fusion, header.frame_id)
        for line in problems:
            if line not in self._warned:
                self._warned.add(line)
                self._node.get_logger().warning(line)
        transforms = [_transform(item, header) for item in placed]
        self._publisher.publish(TFMessage(transforms=transforms))

    def destroy(self) -> None:
        """End the publisher."""
        if self._publisher is not None:
            self._node.destroy_publisher(self._publisher)


def placeable(fusion: Fusion, global_frame: str) -> tuple[Sequence[MapAlignment], list[str]]:
    """
    Return merged sub-maps whose frame can have a place in one tree, and why the others cannot.

    Two maps that call their frame alike (`map`) would pull it to and fro.
    """
    merged = fusion.in_state(State.MERGED)
    counts = Counter(item.submap.frame_id.lstrip('/') for item in merged)
    placed, problems = [], []
    for item in merged:
        frame = item.submap.frame_id.lstrip('/')
        if frame == global_frame:
            problems.append(f'{item.submap.map_id}: its frame is called {frame!r} as the global')
        elif counts[frame] > 1:
            problems.append(
                f'frame {frame!r} belongs to {counts[frame]} sub-maps: none of them is in TF'
            )
        else:
            placed.append(item)
    return placed, list(dict.fromkeys(problems))


def _transform(item: MapAlignment, header: Any) -> Any:
    S_global_map = item.S_global_map
    return TransformStamped(
        header=Header(stamp=header.stamp, frame_id=header.frame_id),
        child_frame_id=item.submap.frame_id.lstrip('/'),
        transform=Transform(
            translation=vector(S_global_map.translation),
            rotation=quaternion(S_global_map.rotation),
        ),
    )


def point(values: Floats) -> Any:
    """Point of (3,)."""
    x, y, z = map(float, values)
    return Point(x=x, y=y, z=z)


def vector(values: Floats) -> Any:
    """Vector3 of (3,)."""
    x, y, z = map(float, values)
    return Vector3(x=x, y=y, z=z)


def quaternion(rotation: Floats) -> Any:
    """Quaternion of a rotation (3, 3)."""
    x, y, z, w = map(float, as_rotation(rotation).as_quat())
    return Quaternion(x=x, y=y, z=z, w=w)
