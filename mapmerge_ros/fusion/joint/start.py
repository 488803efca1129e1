# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
First landmarks for the joint merge: generalised Procrustes, all frames at once.

Taking turns (frames onto the mean, mean of the frames) passes an error on to one neighbour per
turn and bends large fleets; one sparse system of all frames has no such limit.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.csgraph
from scipy.spatial.transform import Rotation

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.geometry import Gauge, Similarities, Similarity, generators

STEPS = 3
"""Gauss-Newton steps over the frames; the merge needs its basin, not this optimum."""

SETTLED = 1e-3
"""Largest turn [rad] and growth of a step after which no other is worth its time."""


def initial_points(
    cost: JointCost, S_centre_maps: Mapping[int, Similarity], centre: int, steps: int = STEPS
) -> Floats:
    """
    Landmarks (tracks, 3) in the frame of the central sub-map.

    `S_centre_maps` holds the frame of every sub-map, by index. The centre stays where it is,
    every other frame moves in the group of its own gauge towards the mean of all, `steps` times.
    """
    frames = Similarities.of([S_centre_maps[k] for k in range(len(cost))])
    free = np.arange(7) < cost.gauges[:, None]
    free[centre] = False
    for _ in range(steps):
        if not free.any():
            break
        tangents = _steps(cost, frames, free)
        if not np.isfinite(tangents).all() or np.abs(tangents[:, 6]).max() > 1.0:
            break  # links too weak for a system of all frames: the tree's frames have to do
        frames = _moved(frames, tangents)
        if np.abs(tangents[:, 3:]).max() < SETTLED:
            break
    return _mean(cost, frames, _weights(cost, frames))


def _weights(cost: JointCost, frames: Similarities) -> Floats:
    """Weights (rows,) are informations, so they scale with the frame."""
    weights: Floats = cost.weights + np.finfo(float).tiny
    return weights / frames.scales[cost.segments.owners] ** 2


def _mean(cost: JointCost, frames: Similarities, weights: Floats) -> Floats:
    points = weights[:, None] * frames.apply(cost.segments, cost.points_map)
    totals = [np.bincount(cost.tracks, weights=axis) for axis in points.T]
    return np.column_stack(totals) / np.bincount(cost.tracks, weights=weights)[:, None]


def _steps(cost: JointCost, frames: Similarities, free: Mask) -> Floats:
    """Tangents (maps, 7) of all frames, in the order of `generators`, towards the common mean."""
    maps = len(cost)
    weights = _weights(cost, frames)
    placed = frames.apply(cost.segments, cost.points_map)
    apart = placed - _mean(cost, frames, weights)[cost.tracks]
    owners = cost.segments.owners
    tangents = generators(placed, Gauge.SIMILARITY) * free[owners][:, None, :]
    weighted = weights[:, None, None] * tangents
    own = cost.segments.products(weighted, tangents)
    own[:, range(7), range(7)] += ~free
    sums = _by_track(cost, weighted)
    totals = np.repeat(np.bincount(cost.tracks, weights=weights), 3)
    blocks = scipy.sparse.bsr_array((own, np.arange(maps), np.arange(maps + 1)))
    matrix = blocks.tocsr() - sums.T @ (scipy.sparse.diags_array(1.0 / totals) @ sums)
    right = cost.segments.sums(np.einsum('mia,mi->ma', weighted, apart))
    return -_solve_banded(matrix.tocoo(), right.ravel()).reshape(maps, 7)


def _by_track(cost: JointCost, values: Floats) -> scipy.sparse.csr_array:
    """Values (rows, 3, 7) as a matrix (3 tracks, 7 maps)."""
    rows = 3 * cost.tracks[:, None, None] + np.arange(3)[:, None]
    columns = 7 * cost.segments.owners[:, None, None] + np.arange(7)
    at, where = (part.ravel() for part in np.broadcast_arrays(rows, columns))
    matrix = scipy.sparse.csr_array(
        (np.asarray(values, np.float64).ravel(), (at, where)),
        shape=(3 * cost.count, 7 * len(cost)),
    )
    matrix.eliminate_zeros()
    return matrix


def _solve_banded(matrix: scipy.sparse.coo_array, right: Floats) -> Floats:
    """Solve with frames in the order of Cuthill & McKee; nan where that fails."""
    graph = scipy.sparse.csr_array(
        (np.ones(matrix.nnz), (matrix.row // 7, matrix.col // 7)), shape=(len(right) // 7,) * 2
    )
    order = scipy.sparse.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True)
    place = np.empty(len(right), np.int64)
    place[(7 * order[:, None] + np.arange(7)).ravel()] = np.arange(len(right))
    row, column = place[matrix.row], place[matrix.col]
    lower = row >= column
    banded = np.zeros((int((row - column).max()) + 1, len(right)), order='F')
    banded[(row - column)[lower], column[lower]] = matrix.data[lower]
    sorted_right = np.empty(len(right))
    sorted_right[place] = right
    try:
        solved = scipy.linalg.solveh_banded(banded, sorted_right, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        return np.full(len(right), np.nan)
    return np.asarray(solved[place])


def _moved(frames: Similarities, steps: Floats) -> Similarities:
    rotations = Rotation.from_rotvec(steps[:, [4, 5, 3]]).as_matrix()
    growth = np.exp(steps[:, 6])
    turned = np.einsum('nij,nj->ni', rotations, frames.translations)
    return Similarities(
        growth * frames.scales,
        rotations @ frames.rotations,
        growth[:, None] * turned + steps[:, :3],
    )
