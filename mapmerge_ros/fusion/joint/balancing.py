# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Steps without a factorisation: balancing domain decomposition (Mandel 1993).

Each sub-map answers alone what its landmarks would do (R is its factor, as it came), and one small
system of all frames makes up for what no sub-map knows: how it lies among the others. Work and
memory grow with the number of sub-maps, and the number of steps does not (docs/algorithm.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.linalg.blas import dgemm, stpsv

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.blas import times_lower
from mapmerge_ros.fusion.joint.banded import Banded
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.fusion.joint.derivatives import low_rank
from mapmerge_ros.fusion.joint.root import Unpacked, scratch_size
from mapmerge_ros.fusion.joint.start import inverse_of_each, turned_information
from mapmerge_ros.fusion.joint.trust import Trust
from mapmerge_ros.fusion.members import grouped
from mapmerge_ros.geometry import Gauge, generators

RELAXATION = 0.6
"""Factor that puts the eigenvalues, from 1 to about 3.3 by themselves, on both sides of 1."""

LEAST = 1e-12
"""
Share by which the diagonal of the frames' system grows.

Two sub-maps that know the same of the same landmarks have the same motions; without it that
system would be singular, and with it their motions are shared out.
"""

FEWEST = 16
"""
Sub-maps from which balanced steps cost less than a factorisation.

About 13 of them do, however many the sub-maps: they take three quarters of the time at 16 drones,
half at 64, a third at 1024.
"""

SMALLEST = 300_000
"""
Sum of (3s)² over the sub-maps from which it is so: of less, a factor is made in no time.

40 sub-maps of 26 shared landmarks each, where both take the same time.
"""

LANDMARKS_PER_MAP = 10.0
"""Shared landmarks per sub-map from which the system of the frames is small beside the whole."""

MOST_VIEWS = 10.0
"""
Sub-maps that see the landmark of a member, on average, up to which neighbours are few.

Where all sub-maps see the same place, what is kept of pairs would grow with their square.
"""

DEPENDENT = 1e-9
"""Square of a motion, of columns of length one, up to which it moves nothing."""

PATIENCE = 6
"""Steps before it is asked how they get on: what they have learned of the matrix helps by then."""

OVERSHOOT = 1.0
"""
By how many times its promise a step may raise the cost.

On a quadratic cost none does, as no eigenvalue exceeds 2: here it bends, and a factor is better.
"""

STEPS_PER_ROOT = 3.0
"""
Steps that cost as much as a factorisation, over the square root of the number of sub-maps.

On a plane a factorisation grows like n^1.5, a step like n: 24 steps for 64 drones, 96 for 1024.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Balanced:
    """
    Stands for the inverse of the Gauss-Newton matrix A = Σ J'J at a state.

    Times A, its eigenvalues are between 0.6 and about 2, where they are not 0 (the gauge).
    """

    cost: JointCost
    places: Floats
    """(rows, 3, 3) D B^-1 of each member: its answer, as a share of the landmark's step"""
    still: scipy.sparse.csr_array
    """(3 rows, 7 maps) orthonormal bases of what R hardly sees: where the map is, and how large"""
    motions: scipy.sparse.csr_array
    """C (3 tracks, 7 maps): how landmarks move when frames do, each by its share"""
    neighbours: tuple[Ints, ...]
    """Per map those that move some of its landmarks (m,)"""
    pulls: tuple[Floats, ...]
    """Per map J'J of the motions of its neighbours (3s, 7m), float32"""
    frames: Banded
    """C'AC"""

    @property
    def trust(self) -> Trust:
        """Say how long to go on with it."""
        return Trust(STEPS_PER_ROOT * float(np.sqrt(len(self.cost))), PATIENCE, OVERSHOOT)

    def solve(self, right: Floats) -> Floats:
        """
        Solve for a right-hand side (3 tracks,), within a factor of two in every direction.

        Not numbers where some R does not determine a landmark.
        """
        with np.errstate(all='ignore'):
            return self._solved(right)

    def _solved(self, right: Floats) -> Floats:
        size = float(np.abs(right).max())  # float32 has no numbers below 1e-38
        forces = right / size if size > 0.0 else right
        moves = self._of_frames(forces)
        steps = self._alone(forces - self._pulled(moves))
        moves -= self.frames.solve(self._resisted(steps))
        steps += self.motions @ moves.ravel()
        return RELAXATION * size * steps

    def _of_frames(self, forces: Floats) -> Floats:
        """Moves of the frames (maps, 7) by forces (3 tracks,), no landmark moving by itself."""
        return self.frames.solve((forces @ self.motions).reshape(-1, 7))

    def _pulled(self, moves: Floats) -> Floats:
        """A C times moves of frames (maps, 7): forces (3 tracks,)."""
        segments, small = self.cost.segments, moves.astype(np.float32)
        pulled = np.empty((len(segments.owners), 3))
        for k, (near, pull) in enumerate(zip(self.neighbours, self.pulls, strict=True)):
            pulled[segments.rows(k)] = (pull @ small[near].ravel()).reshape(-1, 3)
        return self.cost.by_track(pulled).ravel()

    def _resisted(self, steps: Floats) -> Floats:
        """C' A times steps (3 tracks,): (maps, 7)."""
        segments = self.cost.segments
        small = steps.reshape(-1, 3)[self.cost.tracks].astype(np.float32)
        resisted = np.zeros((len(segments), 7))
        for k, (near, pull) in enumerate(zip(self.neighbours, self.pulls, strict=True)):
            resisted[near] += (small[segments.rows(k)].ravel() @ pull).reshape(-1, 7)
        return resisted

    def _alone(self, forces: Floats) -> Floats:
        """Steps (3 tracks,) that each sub-map by itself would make of forces, shared out."""
        cost = self.cost
        own = np.einsum('mji,mj->mi', self.places, forces.reshape(-1, 3)[cost.tracks])
        own = self._without_frame(own).astype(np.float32)
        scratch = np.empty(scratch_size(3 * int(cost.segments.lengths.max())), np.float32)
        for k, root in enumerate(cost.roots):
            rows = cost.segments.rows(k)
            triangle = scratch[: scratch_size(root.columns)]
            triangle[: len(root.packed)] = root.packed
            # The last coordinates stay, for place and size: R determines all others.
            known = max(min(len(root.c), root.columns - Gauge.SIMILARITY), 0)
            triangle[len(triangle) - scratch_size(root.columns - known) :] = 1.0
            half = stpsv(root.columns, triangle, own[rows].ravel(), lower=1, overwrite_x=1)
            half[known:] = 0.0
            answer = stpsv(root.columns, triangle, half, lower=1, trans=1, overwrite_x=1)
            own[rows] = answer.reshape(-1, 3)
        weights = np.array([root.weight for root in cost.roots])[cost.segments.owners]
        answers = self._without_frame(own / weights[:, None])
        steps = np.einsum('mij,mj->mi', self.places, answers)
        return cost.by_track(steps).ravel()

    def _without_frame(self, values: Floats) -> Floats:
        """Forces or displacements (rows, 3), without what moves, turns or scales a whole map."""
        flat = values.ravel()
        rest: Floats = flat - self.still @ (flat @ self.still)
        return rest.reshape(-1, 3)


def pays(cost: JointCost) -> bool:
    """Whether balanced steps cost less than a factorisation, and no more memory."""
    maps, views = len(cost), np.bincount(cost.tracks)
    if maps < FEWEST or np.sum((3 * cost.segments.lengths) ** 2) < SMALLEST:
        return False
    if cost.count < LANDMARKS_PER_MAP * maps:
        return False
    return float(views @ views) <= MOST_VIEWS * len(cost.tracks)


def balanced(cost: JointCost, state: State) -> Balanced:
    """
    Prepare steps at a state.

    Raises
    ------
    numpy.linalg.LinAlgError
        The frames of some sub-maps are not determined by the others.

    """
    owners = cost.segments.owners
    S_global_maps = state.S_map_globals.inverse()
    information = turned_information(cost, S_global_maps)
    total = inverse_of_each(cost.by_track(information))
    places = total[cost.tracks] @ information @ S_global_maps.linear()[owners]
    still = generators(cost.growth, Gauge.SIMILARITY)
    # What a sub-map knows of its scale or place, it knows badly: there, too, frames decide.
    moves = np.ones((len(cost), 7), bool)
    # One holds the frame of all: any of those with the smallest gauge.
    gauge = cost.gauges.min()
    moves[np.argmax(np.where(cost.gauges == gauge, cost.segments.lengths, 0)), :gauge] = False
    moving = generators(state.moved - cost.centres_map[owners], Gauge.SIMILARITY)
    motions = places @ (moving * moves[owners][:, None, :])
    neighbours, pulls, frames = _couple(cost, state, motions, moves)
    order, ends = grouped(cost.tracks, cost.count)
    return Balanced(
        cost,
        places,
        _by_map(_orthonormal(cost, still), owners, np.arange(len(owners) + 1)),
        _by_map(motions[order], owners[order], ends),
        neighbours,
        pulls,
        frames,
    )


def _by_map(blocks: Floats, maps: Ints, ends: Ints) -> scipy.sparse.csr_array:
    """Blocks (n, 3, 7), those from ends[k] to ends[k + 1] in row k and in the column of a map."""
    shape = 3 * (len(ends) - 1), 7 * (int(maps.max()) + 1)
    return scipy.sparse.bsr_array((blocks, maps, ends), shape=shape).tocsr()


def _orthonormal(cost: JointCost, columns: Floats) -> Floats:
    """Orthonormal basis (rows, 3, 7) of the columns of each map; zeros where they are fewer."""
    owners = cost.segments.owners
    sizes = np.sqrt(cost.segments.sums(np.einsum('mia,mia->ma', columns, columns)))
    scaled = columns / np.maximum(sizes, np.finfo(float).tiny)[owners][:, None, :]
    # Two landmarks, or those on one line, do not turn about it.
    squares, axes = np.linalg.eigh(cost.segments.products(scaled, scaled))
    lengths = np.where(squares > DEPENDENT, np.sqrt(np.maximum(squares, DEPENDENT)), np.inf)
    basis: Floats = scaled @ (axes / lengths[:, None, :])[owners]
    return basis


@dataclass(frozen=True, slots=True, eq=False)
class _Meetings:
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
    def of(cls, cost: JointCost) -> _Meetings:
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


def _couple(
    cost: JointCost, state: State, motions: Floats, moves: Mask
) -> tuple[tuple[Ints, ...], tuple[Floats, ...], Banded]:
    """Per map its neighbours and the pulls of their motions; and the system of all frames."""
    met, maps = _Meetings.of(cost), len(cost)
    pulls, blocks = zip(*_pulls(cost, state, motions, met), strict=True)
    own = np.einsum('kaa->ka', diagonal := np.zeros((maps, 7, 7)))
    own[...] = ~moves
    rows = [np.repeat(near, len(near)) for near in met.neighbours]
    columns = [np.tile(near, len(near)) for near in met.neighbours]
    every = np.arange(maps)
    frames = Banded.of(
        np.concatenate([*rows, every]),
        np.concatenate([*columns, every]),
        np.concatenate([*blocks, diagonal]),
        maps,
        growth=LEAST,
    )
    return met.neighbours, pulls, frames


def _pulls(
    cost: JointCost, state: State, motions: Floats, met: _Meetings
) -> Iterator[tuple[Floats, Floats]]:
    """Per map J'J X (3s, 7m) and the blocks of X'J'J X (m m, 7, 7), X the neighbours' motions."""
    linear, answer = state.S_map_globals.linear(), low_rank(cost, state)
    moved = linear[cost.segments.owners[met.first]] @ motions[met.second]
    moved = moved.transpose(0, 2, 1)
    unpacked = Unpacked(3 * int(cost.segments.lengths.max()))
    for k, root in enumerate(cost.roots):
        rows, n, m = cost.segments.rows(k), root.columns, len(met.neighbours[k])
        pairs = slice(met.ends[k], met.ends[k + 1])
        by_map = np.zeros((m, 7, n // 3, 3))
        by_map[met.columns[pairs], :, met.first[pairs] - rows.start] = moved[pairs]
        x = by_map.reshape(7 * m, n).T
        left, right = (side[rows].reshape(n, -1) for side in (answer.left, answer.right))
        lower = unpacked.trapezoid(root.packed, n, n).T
        weight, stretch = np.sqrt(root.weight), state.stretches[k]
        x = dgemm(1.0, left, right.T @ x, beta=stretch, c=x, overwrite_c=1)
        times_lower(x, lower, weight, transposed=True)
        block = (x.T @ x).reshape(m, 7, m, 7).transpose(0, 2, 1, 3).reshape(-1, 7, 7)
        times_lower(x, lower, weight)
        x = dgemm(1.0, right, left.T @ x, beta=stretch, c=x, overwrite_c=1)
        turned = x.T.reshape(-1, 3) @ linear[k]
        yield turned.reshape(7 * m, n).T.astype(np.float32), block
