# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Steps without a factorisation: balancing domain decomposition (Mandel 1993).

Each sub-map answers alone what its landmarks would do (R is its factor, as it came), and one small
system of all frames makes up for what no sub-map knows: how it lies among the others. Work and
memory grow with the number of sub-maps, and the number of steps does not (docs/algorithm.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse
from scipy.linalg.blas import stpsv

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.joint.banded import Banded
from mapmerge_ros.fusion.joint.cost import JointCost, State
from mapmerge_ros.fusion.joint.coupling import Meetings, couple
from mapmerge_ros.fusion.joint.root import Root, in_scratch, scratch_size
from mapmerge_ros.fusion.joint.start import as_matrices, inverse_of_each, turned_information
from mapmerge_ros.fusion.joint.trust import Trust
from mapmerge_ros.geometry import Gauge, generators
from mapmerge_ros.submap import unpack

RELAXATION = 0.6
"""Factor that puts the eigenvalues, from 1 to about 3.3 by themselves, on both sides of 1."""

FEWEST = 16
"""
Sub-maps from which balanced steps cost less than a factorisation.

12 of them do for 16 drones and 18 for 1024: they take three quarters of the time at 16, half at
64, a quarter at 1024.
"""

SMALLEST = 300_000
"""
Sum of (3s)² over the sub-maps from which it is so: of less, a factor is made in no time.

40 sub-maps of 29 shared landmarks each; there both take about the same time.
"""

LANDMARKS_PER_MAP = 10.0
"""Shared landmarks per sub-map from which the system of the frames is small beside the whole."""

MOST_VIEWS = 10.0
"""
Sub-maps that see the landmark of a member, on average, up to which neighbours are few.

Where all sub-maps see the same place, what is kept of pairs would grow with their square.
"""

HELD = 1e-5
"""Singular value, over the largest, up to which R does not see size or place: it is float32."""

NEGLIGIBLE = 1e-9
"""What a turn moves, over what growing moves, below which it is rounding."""

DEPENDENT = 1e-9
"""Square of a motion, of columns of length one, up to which it moves nothing."""

PATIENCE = 6
"""Steps before it is asked how they get on: what they have learned of the matrix helps by then."""

OVERSHOOT = 1.0
"""
By how many times its promise a step may raise the cost.

On a quadratic cost hardly any does, with eigenvalues up to 2: one that bends is left to a factor.
"""

IDENTITIES = tuple(np.eye(size)[np.triu_indices(size)] for size in range(8))
"""Packed triangles of size 0 to 7."""

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
    held: Floats
    """(maps, 7, 7) what answers to forces on the last seven coordinates, all others following"""
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
            triangle = in_scratch(root.packed, root.columns, scratch)
            # By elimination: where R leaves the last coordinates free, they stay.
            last = min(Gauge.SIMILARITY, root.columns)
            triangle[len(triangle) - scratch_size(last) :] = IDENTITIES[last]
            half = stpsv(root.columns, triangle, own[rows].ravel(), lower=1, overwrite_x=1)
            half[-last:] = self.held[k, -last:, -last:] @ half[-last:]
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


def balanced(cost: JointCost, state: State) -> Balanced | None:
    """
    Prepare steps at a state; none where what is kept of neighbours would exceed what R takes.

    Raises
    ------
    numpy.linalg.LinAlgError
        The frames of some sub-maps are not determined by the others.

    """
    met = Meetings.of(cost)
    sizes, near = 3 * cost.segments.lengths, np.array([len(own) for own in met.neighbours])
    if np.sum(49 * near**2 + 7 * near * sizes) > np.sum(sizes**2):
        return None
    owners = cost.segments.owners
    S_global_maps = state.S_map_globals.inverse()
    information = turned_information(cost, S_global_maps)
    total = inverse_of_each(cost.by_track(information))
    places = total[cost.tracks] @ information @ S_global_maps.linear()[owners]
    still = generators(cost.growth, Gauge.SIMILARITY)
    # What a sub-map knows of its scale or place, it knows badly: there, too, frames decide.
    moving = generators(state.moved - cost.centres_map[owners], Gauge.SIMILARITY)
    motions = places @ moving
    pulls, frames = couple(cost, state, motions, met)
    (by_track,) = as_matrices(cost, motions)
    return Balanced(
        cost,
        places,
        scipy.sparse.bsr_array(
            (_orthonormal(cost, still), owners, np.arange(len(owners) + 1))
        ).tocsr(),
        by_track.tocsr(),
        met.neighbours,
        pulls,
        np.array([_held(root) for root in cost.roots]),
        frames,
    )


def _held(root: Root) -> Floats:
    """
    (R22'R22)⁺ (7, 7) of the last rows and columns of R, which see size and place if anything.

    Zero for gauge 7: R has no such rows.
    """
    held = np.zeros((7, 7), np.float32)
    last = min(Gauge.SIMILARITY, root.columns)
    rows = len(root.c) - (root.columns - last)
    if rows > 0:
        own = root.packed[scratch_size(root.columns) - scratch_size(last) :]
        inverse = np.linalg.pinv(unpack(own, last, rows), rcond=HELD)
        held[-last:, -last:] = inverse @ inverse.T
    return held


def _orthonormal(cost: JointCost, columns: Floats) -> Floats:
    """Orthonormal basis (rows, 3, 7) of the columns of each map; zeros where they are fewer."""
    owners = cost.segments.owners
    sizes = np.sqrt(cost.segments.sums(np.einsum('mia,mia->ma', columns, columns)))
    # Turning about an axis on which all landmarks lie is rounding, and no direction.
    turns = sizes[:, 3:6]
    turns[turns < NEGLIGIBLE * sizes[:, 6:]] = np.inf
    scaled = columns / sizes[owners][:, None, :]
    # Two landmarks, or those on one line, do not turn about it.
    squares, axes = np.linalg.eigh(cost.segments.products(scaled, scaled))
    lengths = np.where(squares > DEPENDENT, np.sqrt(np.maximum(squares, DEPENDENT)), np.inf)
    basis: Floats = scaled @ (axes / lengths[:, None, :])[owners]
    return basis
