# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
The gauge of a map: which frame transforms its data cannot see.

A monocular map is known up to a similarity (7), a metric one up to a rigid motion (6), a
visual-inertial one up to translation and yaw (4, z axis up), a georeferenced one exactly (0).
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from mapmerge_ros.arrays import Floats


class Gauge(IntEnum):
    """Dimension of the null space of a map, and name of its transform group."""

    SIMILARITY = 7
    RIGID = 6
    YAW_TRANSLATION = 4
    NONE = 0

    @property
    def minimal_points(self) -> int:
        """Points that determine a transform of this group."""
        return {7: 3, 6: 3, 4: 2, 0: 0}[int(self)]


def generators(points: Floats, gauge: Gauge) -> Floats:
    """
    Displacement of each point per unit of each group parameter, (n, 3, g).

    The columns are translation x y z, rotation z x y, log scale: every smaller gauge is a
    prefix of the larger ones.
    """
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    columns = np.zeros((*points.shape[:-1], 3, 7))
    columns[..., 0, 0] = columns[..., 1, 1] = columns[..., 2, 2] = 1.0
    columns[..., 0, 3], columns[..., 1, 3] = -y, x
    columns[..., 1, 4], columns[..., 2, 4] = -z, y
    columns[..., 0, 5], columns[..., 2, 5] = z, -x
    columns[..., :, 6] = points
    return columns[..., : int(gauge)]


def gauge_basis(points: Floats, gauge: Gauge) -> Floats:
    """Orthonormal basis of the null space at `points` (n, 3): (3n, g)."""
    if gauge is Gauge.NONE:
        return np.zeros((3 * len(points), 0))
    centred = points - points.mean(axis=0)
    return np.linalg.qr(generators(centred, gauge).reshape(-1, int(gauge)))[0]
