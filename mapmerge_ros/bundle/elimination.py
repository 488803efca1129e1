# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What elimination of everything but the shared landmarks leaves, and the way back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.bundle.lens import COUNT
from mapmerge_ros.bundle.linearise import Linearisation

MAX_POINT_CONDITION = 1e10
"""
Condition number of a point's normal equations up to which 6 digits of its block survive.

Beyond it (a point near infinity, two key frames at the same place) Schur complements cancel. Rays
that meet at 2e-5 rad have it: a fiftieth of a pixel, in which nothing says how far the point is.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Elimination:
    """
    r'r ≈ a² + |R δq + c|² for the shared points, and ds/dq (eq. 4) for the rest.

    δs = session_by_shared δq + session_offset are the best poses and lenses for given shared
    points; the offset is zero where the bundle is at its optimum.
    """

    a: float
    r: Floats
    """(3k - gauge, 3k) upper trapezoid"""
    c: Floats
    """(3k - gauge,)"""
    session_by_shared: Floats
    """(6m + 7 l, 3k)"""
    session_offset: Floats
    """(6m + 7 l,)"""
    shared_rows: Ints
    """(k,) rows of the bundle's points"""

    def steps(self, lin: Linearisation, shared_steps: Floats) -> tuple[Floats, Floats, Floats]:
        """Find best poses (m, 6), points (n, 3), lenses (l, 7) for shared points moved (k, 3)."""
        session_steps = self.session_by_shared @ shared_steps.ravel() + self.session_offset
        poses = 6 * len(lin.bundle.keyframe_ids)
        pose_steps = session_steps[:poses].reshape(-1, 6)
        lens_steps = session_steps[poses:].reshape(-1, COUNT)
        point_steps = _best_points(lin, pose_steps, lens_steps)
        point_steps[self.shared_rows] = shared_steps
        return pose_steps, point_steps, lens_steps


def point_information(lin: Linearisation) -> Floats:
    """Information (n, 3, 3) of each point with the cameras held fixed [px² / map unit²]."""
    return sum_by_point(lin, products(lin.by_point, lin.by_point))


def is_determined(information: Floats) -> Mask:
    """Which points (n,) of an information (n, 3, 3) are held in every direction."""
    # A point in a camera's very centre: the decomposition fails on what is not a number.
    finite = np.isfinite(information).all(axis=(1, 2), keepdims=True)
    usable = np.where(finite, information, 0.0)
    found: Mask = np.linalg.cond(usable) < MAX_POINT_CONDITION
    return found


def held(information: Floats) -> Floats:
    """
    Information (n, 3, 3) that can be inverted: as it is where the points are determined.

    Elsewhere no direction is weaker than 1 / MAX_POINT_CONDITION of all: its inverse is large
    where nothing is known, and not the noise of cancelled digits.
    """
    loose = np.flatnonzero(~is_determined(information))
    found = information.copy()
    total = np.trace(found[loose], axis1=1, axis2=2)
    found[loose] += (total / MAX_POINT_CONDITION)[:, None, None] * np.eye(3)
    return found


def products(left: Floats, right: Floats) -> Floats:
    """Left' right (o, j, k) of each observation's blocks (o, 2, j) and (o, 2, k)."""
    found: Floats = left.transpose(0, 2, 1) @ right
    return found


def sum_by_point(lin: Linearisation, values: Floats) -> Floats:
    """Sum per-observation values (o, ...) over the observations of each point, (n, ...)."""
    return _sum_by(lin.bundle.observation_points, len(lin.bundle.point_ids), values)


def sum_by_keyframe(lin: Linearisation, values: Floats) -> Floats:
    """Sum per-observation values (o, ...) over the observations of each key frame, (m, ...)."""
    return _sum_by(lin.bundle.observation_keyframes, len(lin.bundle.keyframe_ids), values)


def _sum_by(rows: Ints, count: int, values: Floats) -> Floats:
    order = np.argsort(rows, kind='stable')
    starts = np.searchsorted(rows[order], np.arange(count))
    sums = np.add.reduceat(values[order], np.minimum(starts, len(order) - 1), axis=0)
    sums[np.bincount(rows, minlength=count) == 0] = 0.0
    return sums


def _best_points(lin: Linearisation, pose_steps: Floats, lens_steps: Floats) -> Floats:
    """Least-squares step (n, 3) of every point after poses and lenses have moved."""
    moved = pose_steps[lin.bundle.observation_keyframes]
    residuals = lin.residuals_px + np.einsum('oij,oj->oi', lin.by_pose, moved)
    residuals += lin.by_lens @ lens_steps.ravel()
    gradient = sum_by_point(lin, np.einsum('oij,oi->oj', lin.by_point, residuals))
    steps: Floats = np.linalg.solve(held(point_information(lin)), -gradient[:, :, None])[:, :, 0]
    return steps
