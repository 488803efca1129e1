# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The merged map in the form in which the sub-maps came: (q̄, ā, R̄, c̄), and a catalogue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats, Ids, Ints, Mask
from mapmerge_ros.blas import inverse_of_positive
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.element import Element, Placement, coordinates
from mapmerge_ros.fusion.merge import assemble
from mapmerge_ros.geometry import Gauge, gauge_basis
from mapmerge_ros.submap import factor_information


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """Merge Jacobian squared, with all frames eliminated: J'J, J'r over every landmark."""

    points: Floats
    """(n, 3) optimum"""
    information: Floats
    """(3n, 3n)"""
    gradient: Floats
    """(3n,)"""
    gauge: Gauge

    def covariance(self, sigma: float) -> Floats:
        """
        Covariance (3n, 3n) of the landmarks, in the gauge that prefers none of them.

        Raises
        ------
        DegenerateGeometry
            A landmark is not determined.

        """
        null = gauge_basis(self.points, self.gauge)
        weight = float(np.mean(np.diag(self.information)))
        try:
            inverse = inverse_of_positive(self.information + weight * null @ null.T)
        except np.linalg.LinAlgError:
            raise DegenerateGeometry('a merged landmark is not determined') from None
        return sigma**2 * (inverse - null @ null.T / weight)

    def without(self, dropped: Mask) -> Normal:
        """Eliminate some landmarks exactly."""
        if not dropped.any():
            return self
        out, kept = coordinates(np.flatnonzero(dropped)), coordinates(np.flatnonzero(~dropped))
        factor = scipy.linalg.cholesky(
            self.information[np.ix_(out, out)], lower=True, check_finite=False
        )
        right = np.column_stack([self.information[np.ix_(out, kept)], self.gradient[out]])
        white = scipy.linalg.solve_triangular(factor, right, lower=True, check_finite=False)
        coupling, offset = white[:, :-1], white[:, -1]
        return Normal(
            self.points[~dropped],
            self.information[np.ix_(kept, kept)] - coupling.T @ coupling,
            self.gradient[kept] - coupling.T @ offset,
            self.gauge,
        )

    def loosened(self, spread: Floats, sigma: float) -> Normal:
        """Take the information down to that of covariance + U U', for U (3n, k) off the gauge."""
        if not spread.shape[1]:
            return self
        pulled = self.information @ spread / sigma
        inner = np.eye(spread.shape[1]) + spread.T @ pulled / sigma
        loss = pulled @ np.linalg.solve(inner, pulled.T)
        return replace(self, information=self.information - 0.5 * (loss + loss.T))

    def triangle(self) -> tuple[Floats, Floats]:
        """R̄ and c̄."""
        return factor_information(
            self.information, self.gradient, gauge_basis(self.points, self.gauge)
        )


def normal_equations(
    elements: Sequence[Element],
    points: Floats,
    placements: Sequence[Placement],
    gauge: Gauge,
) -> Normal:
    """Square the merge Jacobian at the optimum, private landmarks included."""
    return Normal(points, *assemble(elements, placements, points.size), gauge)


def frame_covariance(element: Element, placement: Placement, covariance: Floats) -> Floats:
    """(7, 7) left tangent of S_global_map, from the covariance (3n, 3n) of the landmarks."""
    at = coordinates(element.tracks)
    by_points = element.frame_by_points(placement)
    return np.asarray(by_points @ covariance[np.ix_(at, at)] @ by_points.T)


def most_useful(views: Ints, ids: Ids, limit: int) -> Mask:
    """Which landmarks stay compressed: those in most sub-maps, then by id."""
    keep = np.zeros(len(views), bool)
    keep[np.lexsort((ids, -views))[:limit]] = True
    return keep
