# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A merge near its optimum: every sub-map a quadratic in its own landmarks, all in one frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.element import Element
from mapmerge_ros.geometry import Gauge, generators


@dataclass(frozen=True, slots=True, eq=False)
class Members:
    """Which landmark of which sub-map each row of the statistics is about; by sub-map."""

    maps: Ints
    """(s,) ascending"""
    rows: Ints
    """(s,) row among the shared landmarks of that sub-map"""
    tracks: Ints
    """(s,) merged landmark"""

    def __len__(self) -> int:
        return len(self.maps)

    def of_map(self, k: int) -> slice:
        """Return the members of one sub-map; their coordinates are three times as far."""
        low, high = np.searchsorted(self.maps, [k, k + 1])
        return slice(int(low), int(high))


class Inverse(Protocol):
    """
    Inverse of H = Σ_k A_k'L_k A_k over the merged landmarks, the frame of the result held anyhow.

    How it is held does not matter: the L_k are blind to it, and between them it is always used.
    """

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (3n, m) that no motion of the whole map contributes to."""

    def blocks(self) -> Iterator[tuple[int, Floats]]:
        """Each sub-map k with its own block (3s_k, 3s_k), in the order of its members."""


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """
    Cost of member displacements D at the optimum: Σ_k cost_k + 2 g_k'D_k + D_k'L_k D_k.

    Everything is in the global frame and in units of σ: L_k is the inverse covariance of the
    shape of sub-map k, its frame being free.
    """

    members: Members
    information: tuple[Floats, ...]
    """L_k (3s_k, 3s_k) [1 / map units²]"""
    gradient: Floats
    """g (s, 3) [1 / map units]; its sum over the members of a track is zero"""
    points: Floats
    """(n, 3) optimum"""
    gauges: tuple[Gauge, ...]
    gauge: Gauge
    """Of the merged map"""
    price: float
    """ã / σ²"""
    inverse: Callable[[], Inverse] | None = None
    """Makes H⁻¹ where a factor can be had without dense algebra; None: the dense form has to do"""

    @property
    def views(self) -> Ints:
        """(n,) members of each track."""
        return np.bincount(self.members.tracks, minlength=len(self.points))

    @property
    def dof(self) -> int:
        """Σ 3 κ_i (i - 1) - (Σ g_k - g), eq. 13."""
        locked = 3 * (len(self.members) - len(self.points))
        return locked - (sum(int(own) for own in self.gauges) - int(self.gauge))

    def frames(self, k: int) -> Floats:
        """Displacements (3s_k, g_k) that the data of sub-map k cannot see, orthonormal."""
        points = self.points[self.members.tracks[self.members.of_map(k)]]
        if self.gauges[k] is Gauge.NONE:
            return np.zeros((points.size, 0))
        centred = generators(points - points.mean(axis=0), self.gauges[k])
        basis: Floats = np.linalg.qr(centred.reshape(points.size, -1))[0]
        return basis


def quadratic(
    elements: Sequence[Element], points: Floats, gauge: Gauge, sigma: float
) -> Quadratic:
    """
    Quadratic of a merge at its optimum `points` (n, 3).

    The elements hold shared landmarks only (`Element.reduced`); `sigma` [px] is the noise of a
    residual of unit weight.
    """
    sizes = [len(element.tracks) for element in elements]
    members = Members(
        maps=np.repeat(np.arange(len(elements)), sizes),
        rows=np.concatenate([np.arange(size) for size in sizes]),
        tracks=np.concatenate([element.tracks for element in elements]),
    )
    matrices, gradients, price = [], [], 0.0
    for element in elements:
        placement = element.place(points)
        matrix, gradient = element.derivatives(placement)
        residuals = element.residuals(placement)
        matrices.append(matrix / sigma**2)
        gradients.append(gradient.reshape(-1, 3) / sigma**2)
        price += float(residuals @ residuals) / sigma**2
    gauges = tuple(element.gauge for element in elements)
    return Quadratic(
        members, tuple(matrices), np.concatenate(gradients), points, gauges, gauge, price
    )
