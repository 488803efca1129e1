# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What it does to an old factor that one sub-map has been replaced since.

The old matrix of that sub-map is wrong by much in a few directions, along which a step leaves a
tenth of the error. Its block of the old inverse, which the covariances came across, is enough to
put that right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.blas import mirror
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.derivatives import Jacobians
from mapmerge_ros.fusion.joint.factor import Change, Factor
from mapmerge_ros.fusion.joint.fronts import OPERATIONS_PER_NUMBER, Fronts
from mapmerge_ros.submap import unpack

HIGHEST_CONDITION = 1e4
"""Of 1 + S D, from which what is left of the seven digits of S is not enough."""

SAME_WEIGHT = 1e-6
"""Relative difference up to which two weights are the same: pooling the noise rounds them."""

OPERATIONS = 8.0
"""Of `change`, times (3s)^3: two matrices, two products, one inverse."""


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
        """(3s, 3s) Gauss-Newton matrix of the sub-map, by its landmarks in the global frame."""
        alone = self.cost.only(self.k)
        points = self.points[self.cost.tracks[self.cost.segments.rows(self.k)]]
        jacobian = Jacobians(alone, alone.evaluate(points)).of(0, np.arange(len(points)))
        matrix: Floats = jacobian.T @ jacobian
        return matrix

    def price_in_steps(self, fronts: Fronts) -> float:
        """Steps with a factor of these fronts that cost as much as `change` from this."""
        size = len(self.own_numbers) * 3
        return OPERATIONS * size**3 / OPERATIONS_PER_NUMBER / fronts.read_by_a_step

    @property
    def weight(self) -> float:
        """How much the squared residuals of the sub-map count."""
        return self.cost.roots[self.k].weight

    def counts_as(self, old: Member, scale: float) -> bool:
        """Whether it has the same R, and counts `scale` times as much: then so does its matrix."""
        if not math.isclose(self.weight, scale * old.weight, rel_tol=SAME_WEIGHT):
            return False
        one, two = self.cost.roots[self.k].packed, old.cost.roots[old.k].packed
        return one is two or np.array_equal(one, two)


def change(factor: Factor, old: Member, new: Member, scale: float = 1.0) -> Change | None:
    """
    Change of a factor that was made with the sub-map `old`, which is now `new`.

    All sub-maps count `scale` times as much as before: the factor is to be that of the new matrix
    over the scale. None where the factor does not come with that block of its inverse, where a
    landmark of the old sub-map is none of the merge any more, or where too few digits would be
    left. A landmark that only the new one has is left out: the matrix stays definite.

    Raises
    ------
    DegenerateGeometry
        The landmarks do not determine the frame of the sub-map.
    numpy.linalg.LinAlgError
        The old matrix was that of this sub-map only.

    """
    triangle, had = factor.leaves.get(old.k), old.own_numbers
    if triangle is None or not np.isin(had, new.numbers).all():
        return None
    path = factor.fronts.path(old.k)
    front = factor.fronts.fronts[path[0]]
    landmarks = front.rows[::3] // 3
    at = np.flatnonzero(np.isin(landmarks, had))  # private ones are in the front as well
    covariance = unpack(triangle, 3 * len(at), 3 * len(at)).T
    mirror(covariance)
    slots = np.full(factor.fronts.size // 3, -1)
    slots[landmarks[at]] = np.arange(len(at))
    difference = np.zeros(covariance.shape)
    for member, share in ((old, -1.0), (new, 1.0 / scale)):
        own = slots[member.own_numbers]
        ours, theirs = coordinates(own[own >= 0]), coordinates(np.flatnonzero(own >= 0))
        difference[np.ix_(ours, ours)] += share * member.matrix[np.ix_(theirs, theirs)]
    through = np.eye(len(covariance)) + covariance @ difference
    inverse = np.linalg.inv(through)
    if not np.linalg.norm(through, 1) * np.linalg.norm(inverse, 1) < HIGHEST_CONDITION:
        return None
    response = difference @ inverse
    response = (0.5 * (response + response.T)).astype(factor.storage.dtype)
    return Change(path, front.places[coordinates(at)], response)
