# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Elimination by QR in blocks: for sessions whose normal equations are too ill-conditioned.

Each point is rotated out of its own rows, the remaining rows are collected in one triangle of
poses and lenses, and that triangle meets the shared points: no matrix is ever squared.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.bundle.elimination import Elimination
from mapmerge_ros.bundle.linearise import Linearisation
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.geometry import gauge_basis
from mapmerge_ros.submap import factor_root, triangulate

ROWS_PER_CHUNK = 4096
"""Rows collected before the triangle of poses and lenses absorbs them."""


def eliminate_by_qr(lin: Linearisation, shared_rows: Ints) -> Elimination:
    """
    Same result as `eliminate_by_schur`, with the condition number not squared.

    Raises
    ------
    DegenerateGeometry
        The shared landmarks leave a camera free, or are not determined themselves.

    """
    session, k = lin.session_size, len(shared_rows)
    is_shared = np.zeros(len(lin.bundle.point_ids), bool)
    is_shared[shared_rows] = True
    triangle = _Triangle()
    triangle.absorb(lin.known_rows, lin.known_residuals_px)
    heads: dict[int, tuple[Floats, Floats, Floats]] = {}
    for row, observations in enumerate(_observations_by_point(lin)):
        head, (session_rows, rest) = _rotate_point_out(lin, observations)
        triangle.absorb(session_rows, rest)
        if is_shared[row]:
            heads[row] = head
    session_root, session_vector, a2 = triangle.finish()

    shared_root = np.zeros((3 * k, 3 * k))
    shared_session, shared_vector = np.zeros((3 * k, session)), np.zeros(3 * k)
    for slot, row in enumerate(shared_rows):
        at = slice(3 * slot, 3 * slot + 3)
        shared_root[at, at], shared_session[at], shared_vector[at] = heads[int(row)]
    top, below = _eliminate_session(
        np.vstack([session_root, shared_session]),
        np.vstack([np.zeros((len(session_root), 3 * k)), shared_root]),
        np.concatenate([session_vector, shared_vector]),
    )
    r, c = factor_root(
        below[:, :-1],
        below[:, -1],
        gauge_basis(lin.bundle.points[shared_rows], lin.bundle.gauge),
    )
    a2 += float(below[:, -1] @ below[:, -1]) - float(c @ c)
    return Elimination(float(np.sqrt(max(a2, 0.0))), r, c, -top[:, :-1], -top[:, -1], shared_rows)


def _observations_by_point(lin: Linearisation) -> list[Ints]:
    rows = lin.bundle.observation_points
    order = np.argsort(rows, kind='stable')
    return np.split(order, np.cumsum(np.bincount(rows))[:-1])


def _rotate_point_out(
    lin: Linearisation, observations: Ints
) -> tuple[tuple[Floats, Floats, Floats], tuple[Floats, Floats]]:
    """QR of a point's columns: three rows that hold it, and the rows that are free of it."""
    keyframes = lin.bundle.observation_keyframes[observations]
    blocks = np.zeros((len(observations), 2, len(lin.bundle.keyframe_ids), 6))
    blocks[np.arange(len(observations)), :, keyframes, :] = lin.by_pose[observations]
    rotation, root = np.linalg.qr(lin.by_point[observations].reshape(-1, 3), mode='complete')
    by_session = np.concatenate(
        [blocks.reshape(len(observations), 2, -1), lin.by_lens[observations]], axis=2
    )
    rows = rotation.T @ by_session.reshape(2 * len(observations), -1)
    residuals = rotation.T @ lin.residuals_px[observations].ravel()
    return (root[:3], rows[:3], residuals[:3]), (rows[3:], residuals[3:])


def _eliminate_session(
    by_session: Floats, by_shared: Floats, vector: Floats
) -> tuple[Floats, Floats]:
    """Steps of poses and lenses as a function of [shared | 1], and the rows free of them."""
    rotation, root = np.linalg.qr(by_session, mode='complete')
    count = by_session.shape[1]
    pivots = np.abs(np.diag(root[:count]))
    if len(root) < count or pivots.min() <= 1e-14 * pivots.max():
        raise DegenerateGeometry('the shared landmarks do not hold all cameras: share more')
    rest = rotation.T @ np.column_stack([by_shared, vector])
    return scipy.linalg.solve_triangular(root[:count], rest[:count]), rest[count:]


class _Triangle:
    """Triangle of poses and lenses that absorbs rows in chunks."""

    def __init__(self) -> None:
        self._rows: list[Floats] = []
        self._vectors: list[Floats] = []
        self._pending = 0
        self._left_over = 0.0

    def absorb(self, rows: Floats, vector: Floats) -> None:
        self._rows.append(rows)
        self._vectors.append(vector)
        self._pending += len(rows)
        if self._pending > ROWS_PER_CHUNK:
            self._reduce()

    def finish(self) -> tuple[Floats, Floats, float]:
        """Triangle, its right-hand side, and the sum of squares that no session explains."""
        self._reduce()
        return self._rows[0], self._vectors[0], self._left_over

    def _reduce(self) -> None:
        rows, vector = np.vstack(self._rows), np.concatenate(self._vectors)
        total = float(vector @ vector)
        triangle, rotated = triangulate(rows, vector)
        self._left_over += max(total - float(rotated @ rotated), 0.0)
        self._rows, self._vectors, self._pending = [triangle], [rotated], len(triangle)
