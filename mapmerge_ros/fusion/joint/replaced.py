# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What it does to an old factor that one sub-map has been replaced since.

The old matrix of that sub-map is wrong by much in a few directions, along which a step leaves a
tenth of the error. Its block of the old inverse, which the covariances came across, is enough to
put that right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import stpttr, strttp

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.derivatives import Jacobians
from mapmerge_ros.fusion.joint.factor import Change, Factor, mirrored
from mapmerge_ros.fusion.joint.fronts import Fronts
from mapmerge_ros.fusion.joint.minimise import OPERATIONS_PER_NUMBER

OPERATIONS = 6.7
"""Of `change`, times (3s)^3: two matrices, one product, one system of equations."""


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """One sub-map of a merge."""

    cost: JointCost
    """Of all sub-maps, shared landmarks only"""
    k: int
    points: Floats
    """(tracks, 3) global landmarks"""
    numbers: Ints
    """(tracks,) number of each landmark in the factor"""

    @property
    def own_numbers(self) -> Ints:
        """(s,) number in the factor of each landmark of the sub-map."""
        return self.numbers[self.cost.tracks[self.cost.segments.rows(self.k)]]

    @property
    def matrix(self) -> Floats:
        """Gauss-Newton matrix (3s, 3s) of the sub-map by its landmarks in the global frame."""
        alone = self.cost.only(self.k)
        points = self.points[self.cost.tracks[self.cost.segments.rows(self.k)]]
        jacobian = Jacobians(alone, alone.evaluate(points)).of(0, np.arange(len(points)))
        matrix: Floats = jacobian.T @ jacobian
        return matrix

    def price_in_steps(self, fronts: Fronts) -> float:
        """Steps with a factor of these fronts that cost as much as `change` from this."""
        size = len(self.own_numbers) * 3
        return OPERATIONS * size**3 / OPERATIONS_PER_NUMBER / fronts.read_by_a_step

    def says_the_same(self, other: Member) -> bool:
        """Whether both have the same R, and count as much."""
        one, two = self.cost.roots[self.k], other.cost.roots[other.k]
        if one.weight != two.weight:
            return False
        return one.packed is two.packed or np.array_equal(one.packed, two.packed)


def change(factor: Factor, old: Member, new: Member) -> Change | None:
    """
    Change of a factor that was made with the sub-map `old`, which is now `new`.

    None where the factor does not come with that block of its inverse, or where a landmark of the
    old sub-map is none of the merge any more. A landmark that only the new one has is left out:
    the matrix stays definite.
    """
    packed, had, has = factor.leaves.get(old.k), old.own_numbers, new.own_numbers
    if packed is None or not np.isin(had, new.numbers).all():
        return None
    path = factor.fronts.path(old.k)
    front = factor.fronts.fronts[path[0]]
    at = coordinates(_find(front.rows[::3] // 3, had))
    covariance = unpacked(packed, len(front.rows))[np.ix_(at, at)]
    both = np.isin(has, had)
    ours, theirs = coordinates(_find(had, has[both])), coordinates(np.flatnonzero(both))
    difference = -old.matrix
    difference[np.ix_(ours, ours)] += new.matrix[np.ix_(theirs, theirs)]
    through = np.eye(len(at)) + covariance @ difference
    response = np.linalg.solve(through.T, difference.T).T
    return Change(path, front.places[at], response.astype(factor.storage.dtype))


def packed(block: Floats) -> Floats:
    """Lower triangle of a symmetric matrix (n, n) in float32, packed."""
    triangle: Floats = strttp(block.astype(np.float32), uplo='L')[0]
    return triangle


def unpacked(triangle: Floats, size: int) -> Floats:
    """Symmetric matrix (size, size) in float64 of its packed lower triangle."""
    return mirrored(np.tril(stpttr(size, triangle, uplo='L')[0]).astype(float))


def _find(numbers: Ints, wanted: Ints) -> Ints:
    """Row of each wanted number, which must be there."""
    order = np.argsort(numbers)
    return np.asarray(order[np.searchsorted(numbers, wanted, sorter=order)])
