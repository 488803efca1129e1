# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How the frames of sub-maps hang together where each moves its landmarks by its share of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dgemm

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.blas import times_lower
from mapmerge_ros.fusion.joint.banded import Banded
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.fusion.joint.derivatives import low_rank
from mapmerge_ros.fusion.joint.root import Unpacked
from mapmerge_ros.fusion.members import grouped
from mapmerge_ros.geometry import Gauge, gauge_basis

LEAST = 1e-12
"""
Share by which the diagonal of the frames' system grows.

Motions that cancel at every landmark cost nothing: of two sub-maps that know the same of the same
landmarks, or of one that has two landmarks and turns about both.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Meetings:
    """Pairs of members of one landmark, each with itself too, in the order of the first one."""

    ends: Ints
    """(maps + 1,) pairs whose first member is of each map"""
    first: Ints
    """(pairs,)"""
    second: Ints
    """(pairs,)"""
    neighbours: tuple[Ints, ...]
    """Per map those that have some of its landmarks, itself too, ascending"""
    columns: Ints
    """(pairs,) place of the second one's map among the neighbours of the first one's"""

    @classmethod
    def of(cls, cost: JointCost) -> Meetings:
        """All of them."""
        owners, tracks, maps = cost.segments.owners, cost.tracks, len(cost)
        order, ends = grouped(tracks, cost.count)
        views = np.diff(ends)[tracks]
        starts = np.concatenate([[0], np.cumsum(views)])
        first = np.repeat(np.arange(len(tracks)), views)
        second = order[np.repeat(ends[tracks] - starts[:-1], views) + np.arange(starts[-1])]
        keys, columns = np.unique(owners[first] * maps + owners[second], return_inverse=True)
        bounds = np.searchsorted(keys, maps * np.arange(maps + 1))
        neighbours = np.split(keys % maps, bounds[1:-1])
        columns = columns - bounds[owners[first]]
        return cls(starts[cost.segments.ends], first, second, tuple(neighbours), columns)


def couple(
    cost: JointCost, state: State, motions: Floats, met: Meetings
) -> tuple[tuple[Floats, ...], Banded]:
    """Per map the pulls of its neighbours' motions; and the system of all frames."""
    pulls, blocks = zip(*_pulls(cost, state, motions, met), strict=True)
    rows = np.concatenate([np.repeat(near, len(near)) for near in met.neighbours])
    columns = np.concatenate([np.tile(near, len(near)) for near in met.neighbours])
    return pulls, Banded.of(rows, columns, np.concatenate(blocks), len(cost), growth=LEAST)


def _pulls(
    cost: JointCost, state: State, motions: Floats, met: Meetings
) -> Iterator[tuple[Floats, Floats]]:
    """
    Per map J'J X (3s, 7m) and the blocks of X'J'J X (m m, 7, 7), X the neighbours' motions.

    One map holds the frame of all: those blocks are more by what its landmarks resist being moved
    as a whole.
    """
    linear, answer = state.S_map_globals.linear(), low_rank(cost, state)
    gauge = Gauge(int(cost.gauges.min()))
    holder = middle(cost, state.points)
    moved = linear[cost.segments.owners[met.first]] @ motions[met.second]
    moved = moved.transpose(0, 2, 1)
    unpacked = Unpacked(3 * int(cost.segments.lengths.max()))
    for k, root in enumerate(cost.roots):
        rows, n, m = cost.segments.rows(k), root.columns, len(met.neighbours[k])
        pairs = slice(met.ends[k], met.ends[k + 1])
        by_map = np.zeros((m, 7, n // 3, 3))
        by_map[met.columns[pairs], :, met.first[pairs] - rows.start] = moved[pairs]
        x = by_map.reshape(7 * m, n).T
        resisted = np.zeros((7 * m, 7 * m))
        if k == holder and gauge:
            basis = gauge_basis(state.points[cost.tracks[rows]], gauge).reshape(-1, 3, int(gauge))
            as_a_whole = (state.S_map_globals.rotations[k] @ basis).reshape(n, -1).T @ x
            size = np.einsum('mii->', cost.information[rows]) / n
            resisted = size * (as_a_whole.T @ as_a_whole)
        left, right = (side[rows].reshape(n, -1) for side in (answer.left, answer.right))
        lower = unpacked.trapezoid(root.packed, n, n).T
        weight, stretch = np.sqrt(root.weight), state.stretches[k]
        x = dgemm(1.0, left, right.T @ x, beta=stretch, c=x, overwrite_c=1)
        times_lower(x, lower, weight, transposed=True)
        resisted += x.T @ x
        times_lower(x, lower, weight)
        x = dgemm(1.0, right, left.T @ x, beta=stretch, c=x, overwrite_c=1)
        turned = x.T.reshape(-1, 3) @ linear[k]
        pull = turned.reshape(7 * m, n).T.astype(np.float32)
        yield pull, resisted.reshape(m, 7, m, 7).transpose(0, 2, 1, 3).reshape(-1, 7, 7)


def middle(cost: JointCost, points: Floats) -> int:
    """Map nearest to the middle of all, among those with many landmarks."""
    segments = cost.segments
    shared = segments.counts(cost.weights > 0.0)
    places = segments.sums(points[cost.tracks]) / segments.lengths[:, None]
    distances = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    distances[shared < np.median(shared)] = np.inf
    return int(np.argmin(distances))
