# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A map that only says where its landmarks are and what they look like."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Bytes, Floats
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.submap import Descriptors, DescriptorType, Source, SubMap


def announcement(
    name: str,
    points: Floats,
    descriptors: Bytes,
    std: float | None = None,
    kind: DescriptorType = DescriptorType.BINARY,
    gauge: Gauge = Gauge.SIMILARITY,
) -> SubMap:
    """
    Sub-map of landmarks (n, 3) that are not compressed, without an id space.

    `std` is that of every coordinate, in map units; None: not told. Landmark ids count from 1.
    """
    count = len(points)
    return SubMap(
        map_id=name,
        robot_id=name,
        revision=1,
        stamp_ns=0,
        frame_id=name,
        sources=(Source(name, 1),),
        gauge=gauge,
        id_space='',
        landmark_ids=np.arange(1, count + 1, dtype=np.uint64),
        points=points,
        covariances=None if std is None else _isotropic(std, count),
        compressed_count=0,
        a=0.0,
        packed_r=np.zeros(0, np.float32),
        c=np.zeros(0),
        residual_count=0,
        dof=0,
        sigma=1.0,
        descriptors=Descriptors(kind, descriptors),
    )


def _isotropic(std: float, count: int) -> Floats:
    """Upper triangles (count, 6) of σ² I."""
    return np.tile(std**2 * np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]), (count, 1))
