# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The obvious compression: one dense QR of [J_s J_q r]. Slow; the oracle of the fast ones."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.bundle.elimination import Elimination
from mapmerge_ros.bundle.linearise import Linearisation
from mapmerge_ros.geometry import gauge_basis
from mapmerge_ros.submap import factor_root, upper_qr


def eliminate_densely(lin: Linearisation, shared_rows: Ints) -> Elimination:
    """Q'[J_s J_q r] = [R_ss R_sq c_s; 0 R c; 0 0 a], everything dense."""
    bundle = lin.bundle
    poses = 6 * len(bundle.keyframe_ids)
    private_rows = np.setdiff1d(np.arange(len(bundle.point_ids)), shared_rows)
    jacobian, residuals = dense_jacobian(lin)
    columns = (np.concatenate([private_rows, shared_rows])[:, None] * 3 + [0, 1, 2]).ravel()
    ordered = np.hstack([jacobian[:, :poses], jacobian[:, poses + columns]])
    r = upper_qr(np.column_stack([ordered, residuals]))
    eliminated = poses + 3 * len(private_rows)
    total = eliminated + 3 * len(shared_rows)
    back = scipy.linalg.solve_triangular(r[:eliminated, :eliminated], r[:eliminated, eliminated:])
    rest = r[eliminated:total, eliminated:]
    trapezoid, c = factor_root(
        rest[:, : total - eliminated],
        rest[:, -1],
        gauge_basis(bundle.points[shared_rows], bundle.gauge),
    )
    a2 = float(r[eliminated:, -1] @ r[eliminated:, -1]) - float(c @ c)
    return Elimination(
        float(np.sqrt(max(a2, 0.0))),
        trapezoid,
        c,
        -back[:poses, :-1],
        -back[:poses, -1],
        shared_rows,
    )


def dense_jacobian(lin: Linearisation) -> tuple[Floats, Floats]:
    """Whole Jacobian (η, 6m + 3n) with poses before points, and residuals (η,)."""
    bundle = lin.bundle
    m, n, o = len(bundle.keyframe_ids), len(bundle.point_ids), len(bundle.observation_points)
    by_pose, by_point = np.zeros((o, 2, m, 6)), np.zeros((o, 2, n, 3))
    every = np.arange(o)
    by_pose[every, :, bundle.observation_keyframes, :] = lin.by_pose
    by_point[every, :, bundle.observation_points, :] = lin.by_point
    observed = np.hstack([by_pose.reshape(2 * o, -1), by_point.reshape(2 * o, -1)])
    known = np.hstack([lin.prior_rows, np.zeros((len(lin.prior_rows), 3 * n))])
    residuals = np.concatenate([lin.residuals_px.ravel(), bundle.prior_residuals_px])
    return np.vstack([observed, known]), residuals
