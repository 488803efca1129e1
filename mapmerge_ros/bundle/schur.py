# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Elimination by two Schur complements: private points first, then the cameras."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.bundle.elimination import (
    Elimination,
    point_information,
    sum_by_keyframe,
    sum_by_point,
)
from mapmerge_ros.bundle.linearise import Linearisation
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.geometry import gauge_basis
from mapmerge_ros.submap import factor_information

POINTS_PER_CHUNK = 2048
"""Bounds the dense (6m, 3 chunk) block of eliminated points: 18 MB for 60 key frames."""


def eliminate_by_schur(lin: Linearisation, shared_rows: Ints) -> Elimination:
    """
    Eliminate all poses and all other points from the normal equations.

    Raises
    ------
    DegenerateGeometry
        The shared landmarks leave a camera free, or are not determined themselves.

    """
    points, keyframes = lin.bundle.points, lin.bundle.observation_keyframes
    m = len(lin.bundle.keyframe_ids)
    blocks = np.einsum('oij,oik->ojk', lin.by_pose, lin.by_point)
    information = point_information(lin)
    gradient = sum_by_point(lin, np.einsum('oij,oi->oj', lin.by_point, lin.residuals_px))
    pose_information = _pose_information(lin)
    pose_gradient = sum_by_keyframe(
        lin, np.einsum('oij,oi->oj', lin.by_pose, lin.residuals_px)
    ).ravel()
    pose_gradient += lin.prior_rows.T @ lin.bundle.prior_residuals_px

    slot = np.full(len(points), -1)
    slot[shared_rows] = np.arange(len(shared_rows))
    shared_slot = slot[lin.bundle.observation_points]
    private_rows = np.flatnonzero(slot < 0)
    explained = 0.0
    for chunk in np.array_split(private_rows, max(1, len(private_rows) // POINTS_PER_CHUNK)):
        if not len(chunk):
            continue
        coupling, scaled = _whitened_chunk(lin, blocks, information, gradient, chunk)
        pose_information -= coupling @ coupling.T
        pose_gradient -= coupling @ scaled
        explained += float(scaled @ scaled)

    seen = shared_slot >= 0
    coupling = np.zeros((m, 6, len(shared_rows), 3))
    coupling[keyframes[seen], :, shared_slot[seen], :] = blocks[seen]
    coupling = coupling.reshape(6 * m, -1)
    try:
        factor = scipy.linalg.cholesky(pose_information, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        raise DegenerateGeometry(
            f'{len(shared_rows)} shared landmarks do not hold all cameras: share more'
        ) from None
    white = scipy.linalg.solve_triangular(
        factor, np.column_stack([coupling, pose_gradient]), lower=True, check_finite=False
    )
    by_shared, offset = white[:, :-1], white[:, -1]
    shared_information = -by_shared.T @ by_shared
    diagonal = shared_information.reshape(len(shared_rows), 3, len(shared_rows), 3)
    every = np.arange(len(shared_rows))
    diagonal[every, :, every, :] += information[shared_rows]
    shared_gradient = gradient[shared_rows].ravel() - by_shared.T @ offset
    r, c = factor_information(
        shared_information, shared_gradient, gauge_basis(points[shared_rows], lin.bundle.gauge)
    )
    a2 = lin.cost_px2 - explained - float(offset @ offset) - float(c @ c)
    back = scipy.linalg.solve_triangular(factor, white, lower=True, trans='T', check_finite=False)
    return Elimination(
        float(np.sqrt(max(a2, 0.0))), r, c, -back[:, :-1], -back[:, -1], shared_rows
    )


def _pose_information(lin: Linearisation) -> Floats:
    """Dense (6m, 6m) information of the poses with all points held fixed."""
    m = len(lin.bundle.keyframe_ids)
    information = np.zeros((m, 6, m, 6))
    every = np.arange(m)
    information[every, :, every, :] = sum_by_keyframe(
        lin, np.einsum('oij,oik->ojk', lin.by_pose, lin.by_pose)
    )
    return information.reshape(6 * m, 6 * m) + lin.prior_rows.T @ lin.prior_rows


def _whitened_chunk(
    lin: Linearisation,
    blocks: Floats,
    information: Floats,
    gradient: Floats,
    chunk: Ints,
) -> tuple[Floats, Floats]:
    """Coupling (6m, 3c) and gradient (3c,) of some points, scaled to unit information."""
    slot = np.full(len(information), -1)
    slot[chunk] = np.arange(len(chunk))
    slots = slot[lin.bundle.observation_points]
    seen = slots >= 0
    try:
        whiten = np.linalg.inv(np.linalg.cholesky(information[chunk]))
    except np.linalg.LinAlgError:
        raise DegenerateGeometry(
            'a point is not determined by its observations: all rays are parallel'
        ) from None
    coupling = np.zeros((len(lin.bundle.keyframe_ids), 6, len(chunk), 3))
    white_blocks = blocks[seen] @ whiten[slots[seen]].transpose(0, 2, 1)
    coupling[lin.bundle.observation_keyframes[seen], :, slots[seen], :] = white_blocks
    scaled = np.einsum('cij,cj->ci', whiten, gradient[chunk])
    return coupling.reshape(-1, 3 * len(chunk)), scaled.ravel()
