# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Elimination by two Schur complements: private points first, then poses and lenses."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.bundle.elimination import (
    Elimination,
    point_information,
    products,
    sum_by_keyframe,
    sum_by_point,
)
from mapmerge_ros.bundle.linearise import Linearisation
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.geometry import gauge_basis
from mapmerge_ros.submap import factor_information

POINTS_PER_CHUNK = 2048
"""Bounds the dense (6m + 7 l, 3 chunk) block of eliminated points: 18 MB for 60 key frames."""


def eliminate_by_schur(lin: Linearisation, shared_rows: Ints) -> Elimination:
    """
    Eliminate all poses, lenses and all other points from the normal equations.

    Raises
    ------
    DegenerateGeometry
        The shared landmarks leave a camera free, or are not determined themselves.

    """
    points = lin.bundle.points
    blocks = products(lin.by_pose, lin.by_point)
    lens_blocks = sum_by_point(lin, products(lin.by_lens, lin.by_point))
    information = point_information(lin)
    gradient = sum_by_point(lin, np.einsum('oij,oi->oj', lin.by_point, lin.residuals_px))
    session_information, session_gradient = _session_equations(lin)

    slot = np.full(len(points), -1)
    slot[shared_rows] = np.arange(len(shared_rows))
    shared_slot = slot[lin.bundle.observation_points]
    private_rows = np.flatnonzero(slot < 0)
    explained = 0.0
    for chunk in np.array_split(private_rows, max(1, len(private_rows) // POINTS_PER_CHUNK)):
        if not len(chunk):
            continue
        coupling, scaled = _whitened_chunk(lin, blocks, lens_blocks, information, gradient, chunk)
        session_information -= coupling @ coupling.T
        session_gradient -= coupling @ scaled
        explained += float(scaled @ scaled)

    seen = shared_slot >= 0
    coupling = _coupling(lin, seen, shared_slot[seen], blocks[seen], lens_blocks[shared_rows])
    try:
        factor = scipy.linalg.cholesky(session_information, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        raise DegenerateGeometry(
            f'{len(shared_rows)} shared landmarks do not hold all cameras: share more'
        ) from None
    white = scipy.linalg.solve_triangular(
        factor, np.column_stack([coupling, session_gradient]), lower=True, check_finite=False
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


def _session_equations(lin: Linearisation) -> tuple[Floats, Floats]:
    """Dense information and gradient (6m + 7 l) of poses and lenses, all points held fixed."""
    m = len(lin.bundle.keyframe_ids)
    poses = np.zeros((m, 6, m, 6))
    every = np.arange(m)
    poses[every, :, every, :] = sum_by_keyframe(lin, products(lin.by_pose, lin.by_pose))
    crossed = sum_by_keyframe(lin, products(lin.by_pose, lin.by_lens))
    crossed = crossed.reshape(6 * m, lin.bundle.lens.size)
    by_lens = lin.by_lens.reshape(lin.residuals_px.size, lin.bundle.lens.size)
    rows = lin.known_rows
    information = np.block(
        [[poses.reshape(6 * m, 6 * m), crossed], [crossed.T, by_lens.T @ by_lens]]
    )
    gradient = np.concatenate(
        [
            sum_by_keyframe(lin, np.einsum('oij,oi->oj', lin.by_pose, lin.residuals_px)).ravel(),
            by_lens.T @ lin.residuals_px.ravel(),
        ]
    )
    return information + rows.T @ rows, gradient + rows.T @ lin.known_residuals_px


def _whitened_chunk(
    lin: Linearisation,
    blocks: Floats,
    lens_blocks: Floats,
    information: Floats,
    gradient: Floats,
    chunk: Ints,
) -> tuple[Floats, Floats]:
    """Coupling (6m + 7 l, 3c) and gradient (3c,) of some points, scaled to unit information."""
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
    turned = whiten.transpose(0, 2, 1)
    coupling = _coupling(
        lin, seen, slots[seen], blocks[seen] @ turned[slots[seen]], lens_blocks[chunk] @ turned
    )
    scaled = np.einsum('cij,cj->ci', whiten, gradient[chunk])
    return coupling, scaled.ravel()


def _coupling(
    lin: Linearisation, seen: Mask, slots: Ints, blocks: Floats, lens_blocks: Floats
) -> Floats:
    """
    Coupling (6m + 7 l, 3k) of k points with poses and lenses.

    `seen` (o,) are their observations, `slots` and `blocks` (s, 6, 3) are of those;
    `lens_blocks` (k, 7 l, 3) are of the points.
    """
    m, k = len(lin.bundle.keyframe_ids), len(lens_blocks)
    coupling = np.zeros((lin.session_size, k, 3))
    poses = coupling[: 6 * m].reshape(m, 6, k, 3)
    poses[lin.bundle.observation_keyframes[seen], :, slots, :] = blocks
    coupling[6 * m :] = lens_blocks.transpose(1, 0, 2)
    return coupling.reshape(lin.session_size, 3 * k)
