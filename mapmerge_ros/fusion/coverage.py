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
import scipy.spatial.distance

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.common import Common

JUDGES = 200
"""Common landmarks of a map whose distances are judged; 500 gave no better choice."""


class Coverage:
    """Square distances to what is chosen, in units of each map's own extent, squared."""

    def __init__(self, common: Common) -> None:
        self._places: Ints = np.full(common.rows.shape, -1)
        self._distances: list[Floats] = []
        """Per map (tracks of it, judges)"""
        self._gaps: list[Floats] = []
        """Per map (judges,)"""
        for submap, rows, places in zip(common.submaps, common.rows, self._places, strict=True):
            own = np.flatnonzero(rows >= 0)
            places[own] = np.arange(len(own))
            distances = _square_distances(submap.points[rows[own]])
            self._distances.append(distances)
            # Nothing chosen is worse than any landmark.
            self._gaps.append(np.full(distances.shape[1], 2.0 * distances.max(initial=0.0)))

    def gain(self, k: int, track: int) -> float:
        """By how much one more landmark lowers the mean of a map."""
        left = self._gaps[k] - self._distances[k][self._places[k, track]]
        return float(np.add.reduce(np.maximum(left, 0.0, out=left))) / len(left)

    def gains(self, k: int) -> Floats:
        """Gain of every track (tracks,) in a map; 0 where it has none."""
        found = np.zeros(self._places.shape[1])
        if self._gaps[k].size:
            left = np.maximum(self._gaps[k] - self._distances[k], 0.0)
            found[self._places[k] >= 0] = left.mean(axis=1)
        return found

    def take(self, k: int, track: int) -> None:
        """Choose a landmark in a map."""
        np.minimum(self._gaps[k], self._distances[k][self._places[k, track]], out=self._gaps[k])


def _square_distances(points: Floats) -> Floats:
    judges = points[:: max(1, -(-len(points) // JUDGES))]
    if not len(points):
        return np.zeros((0, 0))
    squares = scipy.spatial.distance.cdist(points, judges, 'sqeuclidean')
    extent = float(np.sum(np.var(judges, axis=0))) or 1.0
    return np.asarray(squares / extent, np.float32)


def mean_sureness(common: Common) -> Floats:
    """(tracks,) geometric mean of how well the members are determined."""
    logs, counts = np.zeros(common.rows.shape[1]), np.maximum(common.owners.sum(axis=0), 1)
    for sureness, rows in zip(common.sureness, common.rows, strict=True):
        own: Ints = np.flatnonzero(rows >= 0)
        logs[own] += np.log(np.maximum(sureness[rows[own]], np.finfo(float).tiny))
    means: Floats = np.exp(logs / counts)
    return means
