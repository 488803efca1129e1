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
    session = lin.session_size
    private_rows = np.setdiff1d(np.arange(len(bundle.point_ids)), shared_rows)
    jacobian, residuals = dense_jacobian(lin)
    columns = (np.concatenate([private_rows, shared_rows])[:, None] * 3 + [0, 1, 2]).ravel()
    ordered = np.hstack([jacobian[:, :session], jacobian[:, session + columns]])
    r = upper_qr(np.column_stack([ordered, residuals]))
    eliminated = session + 3 * len(private_rows)
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
        -back[:session, :-1],
        -back[:session, -1],
        shared_rows,
    )


def dense_jacobian(lin: Linearisation) -> tuple[Floats, Floats]:
    """Whole Jacobian (η, 6m + 7 l + 3n): poses, lenses, points; and residuals (η,)."""
    bundle = lin.bundle
    m, n, o = len(bundle.keyframe_ids), len(bundle.point_ids), len(bundle.observation_points)
    by_pose, by_point = np.zeros((o, 2, m, 6)), np.zeros((o, 2, n, 3))
    every = np.arange(o)
    by_pose[every, :, bundle.observation_keyframes, :] = lin.by_pose
    by_point[every, :, bundle.observation_points, :] = lin.by_point
    blocks = (by_pose, lin.by_lens, by_point)
    observed = np.hstack([block.reshape(2 * o, block.size // (2 * o)) for block in blocks])
    known = np.hstack([lin.known_rows, np.zeros((len(lin.known_rows), 3 * n))])
    residuals = np.concatenate([lin.residuals_px.ravel(), lin.known_residuals_px])
    return np.vstack([observed, known]), residuals
