# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The rigid motion of an object, from the displacements that its landmarks would take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.local import Sensitivity
from mapmerge_ros.geometry.similarity import skew

MIN_MEMBERS = 4
"""Landmarks from which a rotation is estimated: three that are nearly on a line are usual."""

MAX_ROTATION_STD_RAD = 0.2
"""
Uncertainty of a rotation from which it is not reported.

Beyond, what is left out of the linear landmarks is as large as the rotation.
"""

MAX_STEPS, SETTLED = 10, 1e-6
"""Gauss-Newton, until a step is that share of its own standard deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class RigidMotion:
    """x ↦ centre + R (x - centre) + translation, in the global frame and map units."""

    centre: Floats
    """(3,) mean of the landmarks before the motion"""
    rotation_vector: Floats
    """(3,) [rad]; zero where it is not determined"""
    translation: Floats
    """(3,) of the centre"""
    covariance: Floats
    """
    (6, 6) of rotation and translation; zero for a rotation that is held.

    A rotation error e is one that comes after: R_true = exp(e) R.
    """
    arms: Floats
    """(m, 3) from the centre to the landmarks of the object, after the turn"""

    @property
    def is_turned(self) -> bool:
        """Whether a rotation was estimated."""
        return bool(self.covariance[:3, :3].any())

    def displacements(self, points: Floats) -> Floats:
        """Displacements (n, 3) of points that moved along, given where they were before."""
        turn = Rotation.from_rotvec(self.rotation_vector).as_matrix()
        moved: Floats = (points - self.centre) @ (turn - np.eye(3)).T + self.translation
        return moved

    def of_members(self) -> tuple[Floats, Floats]:
        """Displacement (m, 3) of each landmark of the object, and its covariance (m, 3, 3)."""
        before = Rotation.from_rotvec(-self.rotation_vector).apply(self.arms)
        by_motion = _basis(self.arms)
        covariances = by_motion @ self.covariance @ by_motion.swapaxes(1, 2)
        return self.arms - before + self.translation, covariances


def rigid_motion(state: Sensitivity, points: Floats, members: Ints) -> RigidMotion:
    """
    Maximum-likelihood motion of some members (m,) of one sub-map, others locked.

    `points` (tracks, 3) are the merged landmarks. Those of the object are between old and new
    place while it is locked; where they were before follows from their displacement.
    """
    here = points[state.members.tracks[members]]
    score, information = state.score[members].ravel(), state.block(members)
    follows = state.follow(members) if state.follow else np.zeros_like(information)
    if len(members) >= MIN_MEMBERS:
        motion = _fitted(here, score, information, follows, np.arange(6))
        stds = np.linalg.eigvalsh(motion.covariance[:3, :3])
        if np.isfinite(stds).all() and 0.0 < stds.max() <= MAX_ROTATION_STD_RAD**2:
            return motion
    return _fitted(here, score, information, follows, np.arange(3, 6))


def _fitted(
    here: Floats, score: Floats, information: Floats, follows: Floats, free: Ints
) -> RigidMotion:
    turn, translation, moved = Rotation.identity(), np.zeros(3), np.zeros_like(here)
    for _ in range(MAX_STEPS):
        before = here + (follows @ moved.ravel()).reshape(-1, 3)
        centre = before.mean(axis=0)
        arms = turn.apply(before - centre)
        moved = arms - (before - centre) + translation
        basis = _basis(arms).reshape(-1, 6)[:, free]
        # A line of landmarks says nothing of the turn about it: wide, not singular.
        matrix = basis.T @ information @ basis
        matrix += 1e-12 * np.diag(matrix).max() * np.eye(len(free))
        step = np.zeros(6)
        step[free] = np.linalg.solve(matrix, basis.T @ (score - information @ moved.ravel()))
        angle = float(np.linalg.norm(step[:3]))
        turn = Rotation.from_rotvec(step[:3] * min(1.0, 0.5 / max(angle, 1e-12))) * turn
        translation = translation + step[3:]
        moved = turn.apply(before - centre) - (before - centre) + translation
        if step[free] @ matrix @ step[free] < SETTLED:
            break
    covariance = np.zeros((6, 6))
    covariance[np.ix_(free, free)] = np.linalg.inv(matrix)
    return RigidMotion(
        centre, turn.as_rotvec(), translation, covariance, turn.apply(before - centre)
    )


def _basis(arms: Floats) -> Floats:
    """B (m, 3, 6): displacement of landmarks at `arms` by a turn that comes after, and a shift."""
    return np.concatenate([-skew(arms), np.broadcast_to(np.eye(3), (len(arms), 3, 3))], 2)
