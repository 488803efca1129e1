# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bundles that had no time: Ceres, stopped at a given gradient norm."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.bundle import Bundle, linearise
from mapmerge_ros.simulation import solve

TRUST_RADIUS = 1.0
"""
Radius at which the trust region is held.

Free to grow, it makes full Gauss-Newton steps and jumps over three decades of the gradient at
a time; held at 1, an iteration takes away about half of it, so it can be stopped anywhere.
"""

MAX_ITERATIONS = 300


def descend(bundle: Bundle, gradient_tolerance: float) -> Bundle:
    """
    Iterate until the largest entry of the gradient is below the tolerance, and no further.

    Raises
    ------
    AdjustmentError
        pycolmap is not installed, or the solver failed.

    """
    return solve(
        bundle,
        max_iterations=MAX_ITERATIONS,
        function_tolerance=0.0,
        gradient_tolerance=gradient_tolerance,
        trust_radius=TRUST_RADIUS,
    ).bundle


def gradient_norm(bundle: Bundle) -> float:
    """Euclidean norm of 2 r'J over all poses and points."""
    lin = linearise(bundle)
    by_pose = _summed(lin.by_pose, lin.residuals_px, bundle.observation_keyframes)
    by_point = _summed(lin.by_point, lin.residuals_px, bundle.observation_points)
    return 2.0 * float(np.sqrt(np.sum(by_pose**2) + np.sum(by_point**2)))


def disturbed(bundle: Bundle, rng: np.random.Generator, error_rad: float) -> Bundle:
    """
    Bundle with poses and points put off by `error_rad`, seen from the cameras.

    About the bundle's own optimum, not about the truth: stopping early on the way from a start
    about the truth would look like a gain.
    """
    error = error_rad * float(np.median(bundle.points_camera()[:, 2]))
    turns = error_rad * rng.normal(size=(len(bundle.keyframe_ids), 3))
    shifts = error * rng.normal(size=turns.shape)
    return bundle.moved(
        np.column_stack([turns, shifts]), error * rng.normal(size=bundle.points.shape)
    )


def noisy(truth: Bundle, rng: np.random.Generator, sigma: float) -> Bundle:
    """Return what is true, with noise on its observations."""
    noise = sigma * rng.normal(size=truth.observations_px.shape)
    return replace(truth, observations_px=truth.observations_px + noise, sigma_px=sigma)


def _summed(jacobian: Floats, residuals: Floats, rows: Ints) -> Floats:
    total = np.zeros((int(rows.max()) + 1, jacobian.shape[2]))
    np.add.at(total, rows, np.einsum('oi,oij->oj', residuals, jacobian))
    return total
