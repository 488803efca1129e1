# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
First landmarks for the joint merge: generalised Procrustes, all frames at once.

Every sub-map is a rigid set of landmarks, each as well known as with all others held fixed: a
3 x 3 matrix, as depth is known ten times worse than the rest. Equal in all directions, the same
steps end at ten times the cost, and the merge takes three times the steps.

Taking turns (frames onto the mean, mean of the frames) passes an error on to one neighbour per
turn and bends large fleets; one sparse system of all frames has no such limit.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.sparse
from scipy.spatial.transform import Rotation

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.fusion.joint.banded import Banded
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.members import grouped
from mapmerge_ros.geometry import Gauge, Similarities, Similarity, generators

STEPS = 6
"""Gauss-Newton steps over the frames at most; 64 drones take three, 1024 five."""

LEAST = 1e-9
"""What is known at least in any direction, over what is known in all: no sum is singular."""

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
    return mean_of_members(cost, frames)


def mean_of_members(cost: JointCost, frames: Similarities, counts: Mask | None = None) -> Floats:
    """
    Landmarks (tracks, 3) as the sub-maps see them from their frames S_global_map.

    Only some members (rows,) may count; nan where none of a landmark does.
    """
    information = turned_information(cost, frames)
    if counts is not None:
        information = information * counts[:, None, None]
    placed = frames.apply(cost.segments, cost.points_map)
    return _mean(cost, placed, information, inverse_of_each(cost.by_track(information)))


def turned_information(cost: JointCost, frames: Similarities) -> Floats:
    """Information (rows, 3, 3) of each member in the common frame."""
    least = LEAST * np.einsum('mii->m', cost.information) + np.finfo(float).tiny
    known = cost.information + least[:, None, None] * np.eye(3)
    turned = (frames.rotations / frames.scales[:, None, None])[cost.segments.owners]
    information: Floats = turned @ known @ turned.transpose(0, 2, 1)
    return information


def inverse_of_each(matrices: Floats) -> Floats:
    """Inverse of each (n, 3, 3); nan of zero."""
    none = ~(np.einsum('nii->n', matrices) > 0.0)
    inverse: Floats = np.linalg.inv(np.where(none[:, None, None], np.eye(3), matrices))
    inverse[none] = np.nan
    return inverse


def _mean(cost: JointCost, placed: Floats, information: Floats, inverse: Floats) -> Floats:
    """Landmarks (tracks, 3) from their members (rows, 3) and the inverse of the sums."""
    totals = cost.by_track((information @ placed[:, :, None])[:, :, 0])
    mean: Floats = (inverse @ totals[:, :, None])[:, :, 0]
    return mean


def _steps(cost: JointCost, frames: Similarities, free: Mask) -> Floats:
    """
    Tangents (maps, 7) of all frames, in the order of `generators`, towards the common mean.

    Not numbers where the sub-maps do not determine them together.
    """
    maps, owners = len(cost), cost.segments.owners
    information = turned_information(cost, frames)
    inverse = inverse_of_each(cost.by_track(information))
    placed = frames.apply(cost.segments, cost.points_map)
    apart = placed - _mean(cost, placed, information, inverse)[cost.tracks]
    tangents = generators(placed, Gauge.SIMILARITY) * free[owners][:, None, :]
    weighted = information @ tangents
    own = cost.segments.products(weighted, tangents)
    own[:, range(7), range(7)] += ~free
    blocks = scipy.sparse.bsr_array((own, np.arange(maps), np.arange(maps + 1)))
    pulls, answers = as_matrices(cost, weighted, inverse[cost.tracks] @ weighted)
    matrix = scipy.sparse.bsr_array(blocks - pulls.T @ answers, blocksize=(7, 7))
    right = cost.segments.sums(np.einsum('mia,mi->ma', weighted, apart))
    rows = np.repeat(np.arange(maps), np.diff(matrix.indptr))
    try:
        return -Banded.of(rows, matrix.indices.astype(np.int64), matrix.data, maps).solve(right)
    except np.linalg.LinAlgError:
        return np.full((maps, 7), np.nan)


def as_matrices(cost: JointCost, *each: Floats) -> list[scipy.sparse.bsr_array]:
    """Values (rows, 3, 7) of members, each as a matrix (3 tracks, 7 maps)."""
    order, ends = grouped(cost.tracks, cost.count)
    maps, shape = cost.segments.owners[order], (3 * cost.count, 7 * len(cost))
    return [scipy.sparse.bsr_array((values[order], maps, ends), shape=shape) for values in each]


def _moved(frames: Similarities, steps: Floats) -> Similarities:
    rotations = Rotation.from_rotvec(steps[:, [4, 5, 3]]).as_matrix()
    growth = np.exp(steps[:, 6])
    turned = np.einsum('nij,nj->ni', rotations, frames.translations)
    return Similarities(
        growth * frames.scales,
        rotations @ frames.rotations,
        growth[:, None] * turned + steps[:, :3],
    )
