# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
How well chosen landmarks stand for all that a map has in common with others.

Every common landmark has a square distance to the nearest one that is chosen; the mean of these
is what a choice is judged by. So landmarks are chosen where many are, and apart from each other;
those farthest from each other would be at the rim, where maps are bent and views are few.
"""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.common import Common

JUDGES = 200
"""Common landmarks of a map whose distances are judged; 500 gave no better choice."""

DIGITS = 9
"""Of a gain, so that rounding, which depends on the frame of a map, decides nothing."""


class Coverage:
    """
    Square distances to what is chosen, in units of each map's own extent, squared.

    Distances are made when they are asked for: kept, they would be most of what a choice needs.
    |j - p|² is the product of (-2j, |j|², 1) and (p, 1, |p|²).
    """

    def __init__(self, common: Common) -> None:
        self._maps, self._starts = common.maps.tolist(), common.ends.tolist()
        self._points, self._judges, self._gaps = list[Floats](), list[Floats](), list[Floats]()
        for k, submap in enumerate(common.submaps):
            points = _in_extents(submap.points[common.rows[common.members(k)]])
            squares, ones = np.sum(points**2, axis=1), np.ones(len(points))
            every = slice(None, None, _every(len(points)))
            self._points.append(np.column_stack([points, ones, squares]))
            self._judges.append(np.column_stack([-2.0 * points, squares, ones])[every])
            # Nothing chosen is worse than any landmark.
            farthest = (self._points[k] @ self._judges[k].T).max(initial=0.0)
            self._gaps.append(np.full(len(self._judges[k]), 2.0 * farthest))

    def gain(self, member: int) -> float:
        """By how much one more landmark lowers the mean of its map."""
        k = self._maps[member]
        left = self._gaps[k] - self._distances(member)
        return round(float(np.add.reduce(np.maximum(left, 0.0, out=left))) / len(left), DIGITS)

    def gains(self, k: int, members: Ints) -> Floats:
        """Gains (n,) of members of the k-th map."""
        distances = self._points[k][members - self._starts[k]] @ self._judges[k].T
        left = self._gaps[k] - distances
        means: Floats = np.maximum(left, 0.0, out=left).sum(axis=1) / max(1, left.shape[1])
        return np.round(means, DIGITS)

    def take(self, member: int) -> None:
        """Choose a landmark."""
        k = self._maps[member]
        np.minimum(self._gaps[k], self._distances(member), out=self._gaps[k])

    def _distances(self, member: int) -> Floats:
        k = self._maps[member]
        distances: Floats = self._judges[k] @ self._points[k][member - self._starts[k]]
        return distances


def _in_extents(points: Floats) -> Floats:
    """Points (n, 3) about their middle, in units of the extent of those that judge."""
    if not len(points):
        return points
    judges = points[:: _every(len(points))]
    extent = float(np.sqrt(np.sum(np.var(judges, axis=0)))) or 1.0
    return np.asarray((points - judges.mean(axis=0)) / extent)


def _every(count: int) -> int:
    """Of so many points every which one judges."""
    return max(1, -(-count // JUDGES))
