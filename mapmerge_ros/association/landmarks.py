# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What association knows of a sub-map: positions, covariances, descriptors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.geometry import Gauge, Similarity
from mapmerge_ros.submap import Descriptors, SubMap, symmetric_from_upper


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """All landmarks of a sub-map, by ascending id: their order in a message says nothing."""

    points: Floats
    """(n, 3) in the sub-map's frame"""
    covariances: Floats
    """(n, 3, 3) triangulation covariance [map units²]; zeros where unknown"""
    descriptors: Descriptors
    gauge: Gauge

    @classmethod
    def of(cls, submap: SubMap, rows: Ints) -> Landmarks:
        """Landmarks of a sub-map, compressed or not, in the given order of its rows."""
        covariances: Floats = np.zeros((len(rows), 3, 3))
        if submap.covariances is not None:
            covariances = symmetric_from_upper(submap.covariances[rows])
        return cls(submap.points[rows], covariances, submap.descriptors[rows], submap.gauge)

    def __len__(self) -> int:
        return len(self.points)

    def moved(self, S_new_old: Similarity) -> Landmarks:
        """Return the same landmarks in another frame."""
        linear = S_new_old.scale * S_new_old.rotation
        return Landmarks(
            S_new_old.apply(self.points),
            linear @ self.covariances @ linear.T,
            self.descriptors,
            self.gauge,
        )
