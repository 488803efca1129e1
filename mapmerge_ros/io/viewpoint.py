# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""From where a map is looked at: its middle, its size, and which way is up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.geometry import Gauge

INNER_PERCENT = 95.0
"""Of the points that lie within the radius: SLAM maps have strays near infinity."""


@dataclass(frozen=True, slots=True, eq=False)
class Viewpoint:
    """The frame `view`: right, away and up, its origin in the middle, its unit the radius."""

    middle_global: Floats
    """(3,)"""
    axes: Floats
    """(3, 3) rows: right, away and up, in the global frame"""
    radius: float
    """Global units for one unit of the view"""

    def points(self, points_global: Floats) -> Floats:
        """Points (n, 3) of the view."""
        seen: Floats = (points_global - self.middle_global) @ self.axes.T / self.radius
        return seen

    def directions(self, directions_global: Floats) -> Floats:
        """Displacements (n, 3) of the view."""
        seen: Floats = directions_global @ self.axes.T / self.radius
        return seen

    def covariances(self, covariances_global: Floats) -> Floats:
        """Covariances (n, 3, 3) of the view."""
        seen: Floats = self.axes @ covariances_global @ self.axes.T / self.radius**2
        return seen


def viewpoint(points: Floats, gauge: Gauge) -> Viewpoint:
    """
    Viewpoint of points (n, 3) of one frame.

    Where the gauge does not know what is up, the map lies on its widest side.
    """
    if not len(points):
        return Viewpoint(np.zeros(3), np.eye(3), 1.0)
    middle = np.median(points, axis=0)
    centred = points - middle
    distances = np.linalg.norm(centred, axis=1)
    radius = float(np.percentile(distances, INNER_PERCENT)) or 1.0
    if gauge <= Gauge.YAW_TRANSLATION:
        return Viewpoint(middle, np.eye(3), radius)
    return Viewpoint(middle, _lying(centred[distances <= radius]), radius)


def _lying(centred: Floats) -> Floats:
    """Axes (3, 3) of which the last is the thinnest direction of the points."""
    if len(centred) < 3:
        return np.eye(3)
    right, away = np.linalg.svd(centred, full_matrices=False)[2][:2]
    # An axis has no sign of its own: its largest entry shall be positive.
    right = right * np.sign(right[np.abs(right).argmax()])
    away = away * np.sign(away[np.abs(away).argmax()])
    return np.stack([right, away, np.cross(right, away)])
