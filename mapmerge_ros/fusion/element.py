# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One sub-map inside the joint problem: its share of the cost, and the derivatives of that."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.geometry import Gauge, Similarity, align, generators
from mapmerge_ros.submap import SubMap, alignment_weights, triangulate


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """A sub-map placed on the current landmarks, and how much its size disagrees with them."""

    S_map_global: Similarity
    """T: in the group of the gauge, from the hard gauge constraint"""
    points_map: Floats
    """(s, 3) y = T q"""
    stretch: float
    """Factor that brings y to the size of q°; 1 where the gauge has scale"""
    centre_map: Floats
    """(3,) weighted mean of y, fixed point of the stretch"""

    @property
    def stretched_map(self) -> Floats:
        """Landmarks y (s, 3) at the size of the working point."""
        return self.centre_map + self.stretch * (self.points_map - self.centre_map)


@dataclass(frozen=True, slots=True, eq=False)
class Element:
    """
    |R (y' - q°) + c - log(stretch) R g|², with y = T(q) q_k and T in closed form.

    The hard gauge constraint N'W (y - q°) = 0 (N: generators of the gauge at q°, W: weights of
    the landmarks) makes T a weighted Procrustes of the current landmarks onto q°. It is what
    prevents the collapse to a point of maps without scale, since R q° = 0.

    Metric maps (gauge below 7) know their scale from one weak row only, and what is left of the
    cost still falls as the map shrinks: by a²-like amounts that bias the scale. So the size of
    y is taken out as a stretch (y' has the size of q°) and charged for along the growth g of
    q°. To first order in y - q° both forms are the same.
    """

    gauge: Gauge
    tracks: Ints
    """(s,) row of each landmark in the global q"""
    r: Floats
    """(k, 3s)"""
    c: Floats
    """(k,)"""
    points_map: Floats
    """(s, 3) working point q°"""
    weights: Floats
    """(s,) information of the alignment; zero for a private landmark"""
    is_shared: Mask
    """(s,) whether another sub-map has the landmark too"""
    information: Floats
    """(3s, 3s) R'R, made once"""

    @classmethod
    def from_submap(cls, submap: SubMap, tracks: Ints, is_shared: Mask, weight: float) -> Element:
        """Element of a whole sub-map; its squared residuals count `weight` times."""
        r = np.sqrt(weight) * submap.triangle()
        weights = np.where(is_shared, alignment_weights(r), 0.0)
        return cls(
            gauge=submap.gauge,
            tracks=tracks,
            r=r,
            c=np.sqrt(weight) * submap.c,
            points_map=submap.compressed_points,
            weights=weights / weights.max(),
            is_shared=is_shared,
            information=r.T @ r,
        )

    def reduced(self) -> Element:
        """
        Return the element of the shared landmarks, the private ones marginalised.

        Their columns first in a QR: the rows below them hold for every T (exact).
        """
        private, shared = np.flatnonzero(~self.is_shared), np.flatnonzero(self.is_shared)
        if not len(private):
            return self
        r, c = triangulate(self.r[:, coordinates(np.concatenate([private, shared]))], self.c)
        below = r[3 * len(private) :, 3 * len(private) :]
        return Element(
            gauge=self.gauge,
            tracks=self.tracks[shared],
            r=below,
            c=c[3 * len(private) :],
            points_map=self.points_map[shared],
            weights=self.weights[shared],
            is_shared=self.is_shared[shared],
            information=below.T @ below,
        )

    def place(self, points: Floats) -> Placement:
        """Solve the hard gauge for the global landmarks (tracks, 3)."""
        used = self.weights > 0.0
        S_map_global = align(
            self.points_map[used],
            points[self.tracks[used]],
            gauge=self.gauge,
            weights=self.weights[used],
            scale='tangent',
        ).S_target_source
        moved, stretch = S_map_global.apply(points[self.tracks]), 1.0
        centre = self._mean(moved[used])
        if self.gauge is not Gauge.SIMILARITY:
            growth = self.growth()[used] * self.weights[used, None]
            stretch = np.sum(growth * self.growth()[used]) / np.sum(growth * moved[used])
        return Placement(S_map_global, moved, float(stretch), centre)

    def residuals(self, placement: Placement) -> Floats:
        """R (y' - q°) + c - log(stretch) R g, (k,)."""
        residuals: Floats = self.r @ self._displacement(placement).ravel() + self.c
        return residuals

    def growth(self) -> Floats:
        """Displacement (s, 3) of the working point per unit of log scale, about its centre."""
        return self.points_map - self._mean(self.points_map[self.weights > 0.0])

    def recover_private(self, points: Floats) -> Floats:
        """Best global positions (p, 3) of the private landmarks for given shared ones."""
        private = np.flatnonzero(~self.is_shared)
        placement = self.place(points)
        moved = self._displacement(placement)
        moved[private] = 0.0
        gradient = self.r.T @ (self.r @ moved.ravel() + self.c)
        at = coordinates(private)
        steps = -scipy.linalg.solve(self.information[np.ix_(at, at)], gradient[at], assume_a='pos')
        stretched = self.points_map[private] + steps.reshape(-1, 3)
        stretched = stretched + np.log(placement.stretch) * self.growth()[private]
        moved = placement.centre_map + (stretched - placement.centre_map) / placement.stretch
        recovered: Floats = placement.S_map_global.inverse().apply(moved)
        return recovered

    def derivatives(self, placement: Placement) -> tuple[Floats, Floats]:
        """
        Gauss-Newton matrix (3s, 3s) and gradient (3s,) with respect to the global landmarks.

        A step dq moves T as well, so that the constraint holds: dy = P B dq with B the rotation
        and scale of T, and P = I - G (N'W G)^-1 N'W (G: generators at y). The residual moves by
        R M dy, where M = stretch I + (low rank) accounts for the stretch. M P has the form
        stretch I + U V', so R'R is corrected by a low rank only.
        """
        linear = placement.S_map_global.scale * placement.S_map_global.rotation
        left, right = self._low_rank(placement)
        stretch = placement.stretch
        gradient = self.r.T @ self.residuals(placement)
        gradient = stretch * gradient + right.T @ (left.T @ gradient)
        pulled = self.information @ left
        correction = stretch * pulled @ right
        matrix = stretch**2 * self.information + correction + correction.T
        matrix += right.T @ ((left.T @ pulled) @ right)
        return _rotate_both(matrix, linear), (gradient.reshape(-1, 3) @ linear).ravel()

    def frame_by_points(self, placement: Placement) -> Floats:
        """
        Derivative (7, 3s) of S_global_map (left tangent, order of `Similarity.exp`) by q.

        Rows of directions that the gauge does not free are zero.
        """
        _, response = self._gauge_response(placement)
        size = int(self.gauge)
        linear = placement.S_map_global.scale * placement.S_map_global.rotation
        by_points = response.reshape(size, len(self.tracks), 3) @ linear
        tangent = np.zeros((7, 3 * len(self.tracks)))
        # generators are ordered translation, rotation z x y, scale; exp rotation, translation
        tangent[[3, 4, 5, 2, 0, 1, 6][:size]] = by_points.reshape(size, 3 * len(self.tracks))
        centred = Similarity(1.0, np.eye(3), self._mean(self.points_map[self.weights > 0.0]))
        # The constraint gives T a step -response B dq; the inverse of T moves the other way.
        S_global_map = placement.S_map_global.inverse()
        derivative: Floats = S_global_map.adjoint() @ centred.adjoint() @ tangent
        return derivative

    def _displacement(self, placement: Placement) -> Floats:
        growth: Floats = np.log(placement.stretch) * self.growth()
        return placement.stretched_map - self.points_map - growth

    def _mean(self, points: Floats) -> Floats:
        weights = self.weights[self.weights > 0.0]
        mean: Floats = weights @ points / weights.sum()
        return mean

    def _gauge_response(self, placement: Placement) -> tuple[Floats, Floats]:
        """G (3s, g) at y, and (N'W G)^-1 N'W (g, 3s): how T answers to moved points."""
        size, count = int(self.gauge), 3 * len(self.tracks)
        growth = self.growth()
        centre = self.points_map[0] - growth[0]
        tangent = generators(placement.points_map - centre, self.gauge).reshape(count, size)
        constraint = generators(growth, self.gauge) * self.weights[:, None, None]
        rows = constraint.reshape(count, size).T
        response: Floats = np.linalg.solve(rows @ tangent, rows)
        return tangent, response

    def _low_rank(self, placement: Placement) -> tuple[Floats, Floats]:
        """U (3s, k) and V' (k, 3s) with M P = stretch I + U V'."""
        tangent, response = self._gauge_response(placement)
        if self.gauge is Gauge.SIMILARITY:
            return -tangent, response
        stretch, growth, count = placement.stretch, self.growth(), len(self.tracks)
        weighted = growth * self.weights[:, None]
        by_size = -(stretch**2) / np.sum(weighted * growth) * weighted.reshape(1, -1)
        averaging = np.kron(self.weights / self.weights.sum(), np.eye(3))
        drift = placement.points_map - placement.centre_map - growth / stretch
        left = np.column_stack([np.tile((1.0 - stretch) * np.eye(3), (count, 1)), drift.ravel()])
        right = np.vstack([averaging, by_size])
        through = -stretch * tangent - left @ (right @ tangent)
        return np.column_stack([left, through]), np.vstack([right, response])


def coordinates(rows: Ints) -> Ints:
    """Rows (n,) of points to the rows (3n,) of their coordinates."""
    return (3 * rows[:, None] + np.arange(3)).ravel()


def _rotate_both(matrix: Floats, linear: Floats) -> Floats:
    """B' M B for B = blockdiag(linear)."""
    size = len(matrix)
    right = (matrix.reshape(size, -1, 3) @ linear).reshape(size, size)
    return (right.T.reshape(size, -1, 3) @ linear).reshape(size, size).T
