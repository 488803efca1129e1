# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The points of the global map as a PointCloud2, coloured by robot."""

from __future__ import annotations

import array
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from sensor_msgs.msg import PointCloud2, PointField

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion import Fusion
from mapmerge_ros.io import palette
from mapmerge_ros.io.map_points import SEVERAL, map_points
from mapmerge_ros.io.palette import SHARED, Rgb

POINT = np.dtype(
    [
        ('x', '<f4'),
        ('y', '<f4'),
        ('z', '<f4'),
        ('rgb', '<u4'),
        ('std', '<f4'),
        ('views', '<f4'),
    ]
)
"""rgb is 0x00rrggbb, as the display tools of ROS have it; std is nan where it is not known."""


Colours = npt.NDArray[np.uint32]
"""(n,) 0x00rrggbb"""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points as they go over the wire."""

    data: bytes
    """one `POINT` each"""

    def message(self, header: Any) -> Any:
        """PointCloud2 in the frame of the header."""
        count = len(self.data) // POINT.itemsize
        assert POINT.fields is not None
        return PointCloud2(
            header=header,
            height=1,
            width=count,
            fields=[
                PointField(
                    name=name,
                    offset=offset,
                    # rgb is declared a float by convention: a viewer looks at its bits.
                    datatype=PointField.FLOAT32,
                    count=1,
                )
                for name, (_, offset, *_) in POINT.fields.items()
            ],
            is_bigendian=False,
            point_step=POINT.itemsize,
            row_step=len(self.data),
            data=array.array('B', self.data),
            is_dense=True,
        )


def pack(points: Floats, rgb: Colours | int, std: Floats | float, views: Ints | int) -> Cloud:
    """
    Cloud of points (n, 3); colour, standard deviation and sub-maps of each (n,), or of all.

    Viewers take float32 only. In UTM coordinates that is a quarter of a metre, and `std` says so.
    """
    rows = np.zeros(len(points), POINT)
    rows['x'], rows['y'], rows['z'] = points.T
    steps = np.spacing(np.abs(points).astype(np.float32)).astype(np.float64)
    rounding = np.linalg.norm(steps, axis=1) / np.sqrt(12.0)
    rows['rgb'], rows['std'], rows['views'] = rgb, np.hypot(std, rounding), views
    return Cloud(rows.tobytes())


def robot_colours(fusion: Fusion) -> Mapping[str, Rgb]:
    """Colour of every robot that the fusion knows, as in the report."""
    return palette.robot_colours(item.submap.robot_id for item in fusion.alignments)


def make_cloud(fusion: Fusion) -> Cloud:
    """All points of the published component, catalogues included; several robots' are grey."""
    found = map_points(fusion)
    robots = {item.submap.map_id: item.submap.robot_id for item in fusion.alignments}
    by_robot = robot_colours(fusion)
    table = [*(by_robot[robots[map_id]] for map_id in found.map_ids), SHARED]
    assert SEVERAL == -1  # the last of the table
    packed = np.array([(r << 16) | (g << 8) | b for r, g, b in table], np.uint32)
    std = np.full(len(found), np.nan)
    if fusion.components:
        std_xyz = fusion.components[0].landmarks.std
        std[: found.landmark_count] = np.linalg.norm(std_xyz, axis=1)
    return pack(found.points_global, packed[found.owners], std, found.views)
