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
class Element:
    """
    |R (T(q) q_k - q°) + c|², with T(q) in closed form from the hard gauge constraint.

    The constraint N'W (T q_k - q°) = 0 (N: generators of the gauge at q°, W: weights of the
    landmarks) makes T a weighted Procrustes of the current landmarks onto q°. It is what
    prevents the collapse to a point, since R q° = 0.
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
    def from_submap(
        cls, submap: SubMap, tracks: Ints, is_shared: Mask, weight: float
    ) -> Element:
        """Element of a whole sub-map; its squared residuals count `weight` times."""
        r = np.sqrt(weight) * submap.triangle()
        weights = np.where(is_shared, alignment_weights(r), 0.0)
        return cls(
            gauge=submap.gauge,
            tracks=tracks,
            r=r,
            c=np.sqrt(weight) * submap.c,
            points_map=submap.compressed_points,
            weights=weights,
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

    def place(self, points: Floats) -> Similarity:
        """S_map_global for the global landmarks (tracks, 3): the hard gauge, solved."""
        used = self.weights > 0.0
        return align(
            self.points_map[used],
            points[self.tracks[used]],
            gauge=self.gauge,
            weights=self.weights[used],
            scale='tangent',
        ).S_target_source

    def residuals(self, points: Floats, S_map_global: Similarity) -> Floats:
        """R (T q - q°) + c, (k,)."""
        moved = S_map_global.apply(points[self.tracks]) - self.points_map
        return self.r @ moved.ravel() + self.c

    def recover_private(self, points: Floats) -> Floats:
        """Best global positions (p, 3) of the private landmarks for given shared ones."""
        private = np.flatnonzero(~self.is_shared)
        S_map_global = self.place(points)
        moved = S_map_global.apply(points[self.tracks]) - self.points_map
        moved[private] = 0.0
        gradient = self.r.T @ (self.r @ moved.ravel() + self.c)
        at = coordinates(private)
        steps = -scipy.linalg.solve(self.information[np.ix_(at, at)], gradient[at], assume_a='pos')
        return S_map_global.inverse().apply(self.points_map[private] + steps.reshape(-1, 3))

    def derivatives(self, points: Floats, S_map_global: Similarity) -> tuple[Floats, Floats]:
        """
        Gauss-Newton matrix (3s, 3s) and gradient (3s,) with respect to the global landmarks.

        A step dq moves T as well, so that the constraint holds: d(T q) = P B dq with B the
        rotation and scale of T, and P = I - G (N'W G)^-1 N'W (G: generators at T q).
        """
        tangent, response = self._gauge_response(points, S_map_global)
        linear = S_map_global.scale * S_map_global.rotation
        gradient = self.r.T @ self.residuals(points, S_map_global)
        gradient = gradient - response.T @ (tangent.T @ gradient)
        pulled = self.information @ tangent
        correction = pulled @ response
        matrix = self.information - correction - correction.T
        matrix += response.T @ ((tangent.T @ pulled) @ response)
        return _rotate_both(matrix, linear), (gradient.reshape(-1, 3) @ linear).ravel()

    def transform_by_points(self, points: Floats, S_map_global: Similarity) -> Floats:
        """
        Derivative (7, 3s) of S_global_map (left tangent, order of `Similarity.exp`) by q.

        Rows of directions that the gauge does not free are zero.
        """
        centre = self._centre_map()
        _, response = self._gauge_response(points, S_map_global)
        linear = S_map_global.scale * S_map_global.rotation
        by_points = (response.reshape(-1, len(self.tracks), 3) @ linear).reshape(
            -1, 3 * len(self.tracks)
        )
        tangent = np.zeros((7, by_points.shape[1]))
        # generators: translation, rotation z x y, scale, about the centre of the map's points
        order = [3, 4, 5, 2, 0, 1, 6][: int(self.gauge)]
        tangent[order] = by_points
        centred = Similarity(1.0, np.eye(3), centre).adjoint()
        S_global_map = S_map_global.inverse()
        # d(Tq) = B dq + G x and the constraint give x = -response B dq; T^-1 moves the other way.
        derivative: Floats = S_global_map.adjoint() @ centred @ tangent
        return derivative

    def _centre_map(self) -> Floats:
        centre: Floats = self.weights @ self.points_map / self.weights.sum()
        return centre

    def _gauge_response(
        self, points: Floats, S_map_global: Similarity
    ) -> tuple[Floats, Floats]:
        """G (3s, g) at T q, and (N'W G)^-1 N'W (g, 3s): how T answers to moved points."""
        centre = self._centre_map()
        moved = S_map_global.apply(points[self.tracks])
        size = int(self.gauge)
        tangent = generators(moved - centre, self.gauge).reshape(-1, size)
        constraint = generators(self.points_map - centre, self.gauge) * self.weights[:, None, None]
        rows = constraint.reshape(-1, size).T
        response: Floats = np.linalg.solve(rows @ tangent, rows)
        return tangent, response


def coordinates(rows: Ints) -> Ints:
    """Rows (n,) of points to the rows (3n,) of their coordinates."""
    return (3 * rows[:, None] + np.arange(3)).ravel()


def _rotate_both(matrix: Floats, linear: Floats) -> Floats:
    """B' M B for B = blockdiag(linear)."""
    size = len(matrix)
    right = (matrix.reshape(size, -1, 3) @ linear).reshape(size, size)
    return (right.T.reshape(size, -1, 3) @ linear).reshape(size, size).T
