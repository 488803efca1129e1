# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What moved: the displacement of each landmark of each sub-map, its covariance and its test.

A member (landmark j of sub-map k) is unlocked by giving it a displacement D of its own. The
price of merging is then price - 2 s'D + D'JD, minimised over all landmarks and frames:
J⁻¹s is the displacement, J⁻¹ its covariance, s'J⁻¹s ~ χ²(3) its test. docs/statistics.md
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.linalg import solve_triangular

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.distributions import tail
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.dense_inverse import DenseInverse
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.quadratic import Members, Quadratic


@dataclass(frozen=True, slots=True, eq=False)
class LocalTests:
    """One test per member; nan where there is nothing to test."""

    members: Members
    testable: Mask
    """(s,) locked, and held by another member of its track that is locked as well"""
    distinct: Mask
    """(s,) testable, and not the same test as that of its only partner"""
    statistic: Floats
    """(s,)"""
    p_value: Floats
    """(s,) 1 where there is nothing to test"""
    displacement: Floats
    """(s, 3) global map units: where the sub-map sees it, from where the others do"""
    covariance: Floats
    """(s, 3, 3)"""


class Blocks(Protocol):
    """Matrices by sub-map."""

    def __len__(self) -> int:
        """Return the number of sub-maps."""

    def __getitem__(self, k: int, /) -> Floats:
        """Return the matrix of one."""


class Reduced:
    """
    Blocks less the squares of some columns, each made when somebody asks for it.

    Who tests one object with eleven others unlocked looks at one sub-map of eight.
    """

    def __init__(self, before: Blocks, parts: Sequence[Floats]) -> None:
        """`parts` (3s_k, m): the columns in the rows of each sub-map."""
        self._before, self._parts = before, parts
        self._made: dict[int, Floats] = {}

    def __len__(self) -> int:
        return len(self._parts)

    def __getitem__(self, k: int, /) -> Floats:
        if k not in self._made:
            part = self._parts[k]
            self._made[k] = self._before[k] - part @ part.T
        return self._made[k]


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivity:
    """How the price of merging answers to displacements of members: s and J."""

    members: Members
    score: Floats
    """s (s, 3)"""
    within: Blocks
    """Per sub-map its own block of J (3s_k, 3s_k)"""
    columns: Callable[[Ints], Floats]
    """Columns (3s, 3m) of J of some members (m,), all members locked"""
    price: float
    dof: int
    redundancy: float = np.inf
    """Of the estimate of the variance in the statistics; F instead of χ² where it is finite"""
    unlocked: Mask | None = None
    """(s,)"""
    root: Floats | None = None
    """(3s, 3u) J of the unlocked is taken away as root root'"""
    follow: Callable[[Ints], Floats] | None = None
    """(3m, 3m) how the merged landmarks of some members follow displacements of those"""

    @property
    def locked(self) -> Mask:
        """Members (s,) that keep their landmark where the merge has it."""
        return np.ones(len(self.members), bool) if self.unlocked is None else ~self.unlocked

    def testable(self) -> Mask:
        """(s,) members whose displacement the locked others determine."""
        locked = self.locked
        views = np.bincount(self.members.tracks, weights=locked)
        return np.asarray(locked & (views[self.members.tracks] > 1))

    def information(self) -> Floats:
        """Blocks (s, 3, 3) of J of each member with itself."""
        blocks = []
        for own in (self.within[k] for k in range(len(self.within))):
            count = len(own) // 3
            every = np.arange(count)
            blocks.append(own.reshape(count, 3, count, 3)[every, :, every, :])
        return np.concatenate(blocks)

    def block(self, chosen: Ints) -> Floats:
        """J (3m, 3m) of some members of one sub-map."""
        k = int(self.members.maps[chosen[0]])
        at = coordinates(chosen - self.members.of_map(k).start)
        return self.within[k][np.ix_(at, at)]

    def unlock(self, chosen: Ints) -> Sensitivity:
        """
        Unlock some members, each by a displacement of its own.

        Raises
        ------
        DegenerateGeometry
            The displacement of one of them is not determined by the others.

        """
        if not len(chosen):
            return self
        at = coordinates(chosen)
        columns = self.columns(chosen)
        if self.root is not None:
            columns = columns - self.root @ self.root[at].T
        block = columns[at]
        try:
            factor = np.linalg.cholesky(0.5 * (block + block.T))
        except np.linalg.LinAlgError:
            raise DegenerateGeometry('a landmark without partner cannot be unlocked') from None
        added = solve_triangular(factor, columns.T, lower=True, check_finite=False).T
        scores = self.score[chosen].ravel()
        white = solve_triangular(factor, scores, lower=True, check_finite=False)
        unlocked = ~self.locked
        unlocked[chosen] = True
        return replace(
            self,
            score=self.score - (added @ white).reshape(-1, 3),
            within=Reduced(self.within, self._split(added)),
            price=self.price - float(white @ white),
            dof=self.dof - 3 * len(chosen),
            unlocked=unlocked,
            root=added if self.root is None else np.column_stack([self.root, added]),
        )

    def tests(self) -> LocalTests:
        """Every member by itself, given those that are unlocked."""
        testable, blocks = self.testable(), self.information()
        inverse = np.full_like(blocks, np.nan)
        inverse[testable] = np.linalg.inv(blocks[testable])
        displacement = np.einsum('sij,sj->si', inverse, self.score)
        statistic = np.einsum('si,si->s', self.score, displacement)
        return LocalTests(
            members=self.members,
            testable=testable,
            distinct=testable & self._first_of_two(testable),
            statistic=statistic,
            p_value=np.where(testable, tail(statistic, 3, self.redundancy), 1.0),
            displacement=displacement,
            covariance=inverse,
        )

    def _first_of_two(self, testable: Mask) -> Mask:
        """All but the second member of a track that has only two left."""
        tracks = self.members.tracks
        views = np.bincount(tracks, weights=self.locked)
        first = np.full(len(views), len(tracks))
        rows = np.flatnonzero(testable)
        np.minimum.at(first, tracks[rows], rows)
        return np.asarray((views[tracks] > 2) | (first[tracks] == np.arange(len(tracks))))

    def _split(self, rows: Floats) -> list[Floats]:
        ends = 3 * np.cumsum(np.bincount(self.members.maps, minlength=len(self.within)))[:-1]
        return list(np.split(rows, ends))


def sensitivity(merge: Quadratic, redundancy: float = np.inf) -> Sensitivity:
    """
    Sensitivity of a merge whose noise is known, or estimated from `redundancy` residuals.

    M = blkdiag(L) - L H⁺ L with H = Σ L_k; only its blocks within a sub-map are formed.

    Raises
    ------
    DegenerateGeometry
        The landmarks are not determined by the sub-maps together.

    """
    members, size = merge.members, merge.points.size
    inverse = merge.inverse() if merge.inverse else DenseInverse(merge)
    at = [coordinates(members.tracks[members.of_map(k)]) for k in range(len(merge.information))]
    within = [np.zeros((0, 0))] * len(at)
    for k, block in inverse.blocks():
        own = merge.information[k]
        within[k] = own - _symmetric_product(own, block @ own)

    def pushed(chosen: Ints) -> Floats:
        """L E (3s, 3m): forces that displacements of some members mean for all members."""
        forces = np.zeros((3 * len(members), 3 * len(chosen)))
        for slot, member in enumerate(chosen):
            k = int(members.maps[member])
            part = members.of_map(k)
            inside = 3 * (int(member) - part.start)
            forces[3 * part.start : 3 * part.stop, 3 * slot : 3 * slot + 3] = merge.information[k][
                :, inside : inside + 3
            ]
        return forces

    def answered(forces: Floats, chosen: Ints) -> Floats:
        """H⁻¹ A' forces (3n, 3m): where the merged landmarks go."""
        total = np.zeros((size, forces.shape[1]))
        for k in np.unique(members.maps[chosen]):
            part = members.of_map(int(k))
            total[at[k]] += forces[3 * part.start : 3 * part.stop]
        return inverse.solve(total)

    def columns(chosen: Ints) -> Floats:
        forces = pushed(chosen)
        moved = answered(forces, chosen)
        for k, (own, rows) in enumerate(zip(merge.information, at, strict=True)):
            part = members.of_map(k)
            forces[3 * part.start : 3 * part.stop] -= own @ moved[rows]
        return forces

    def follow(chosen: Ints) -> Floats:
        return -answered(pushed(chosen), chosen)[coordinates(members.tracks[chosen])]

    return Sensitivity(
        members=members,
        score=-merge.gradient,
        within=tuple(within),
        columns=columns,
        price=merge.price,
        dof=merge.dof,
        redundancy=redundancy,
        follow=follow,
    )


def _symmetric_product(left: Floats, right: Floats) -> Floats:
    """Product of (n, n) matrices that is known to be symmetric: three quarters of the work."""
    half = len(left) // 2
    product = np.empty_like(left)
    np.matmul(left, right[:, :half], out=product[:, :half])
    product[:half, half:] = product[half:, :half].T
    np.matmul(left[half:], right[:, half:], out=product[half:, half:])
    return product


def local_tests(merge: Quadratic, redundancy: float = np.inf) -> LocalTests:
    """Test every landmark of every sub-map against all others, Gaussian noise of known σ."""
    return sensitivity(merge, redundancy).tests()


def forward_selection(
    state: Sensitivity, level: float, at_most: int | None = None
) -> tuple[Sensitivity, Ints]:
    """
    Unlock the most significant member below `level`, test again, and so on.

    A wrong member pulls its partners and neighbours: tested once, they are found as well
    (up to 9 % of the unmoved). Returns the final state and the members in the order found.
    """
    found: list[int] = []
    while at_most is None or len(found) < at_most:
        tests = state.tests()
        p_value = np.where(tests.distinct, tests.p_value, 1.0)
        statistic = np.where(tests.distinct, tests.statistic, -np.inf)
        best = int(np.argmax(statistic))
        if not p_value[best] < level:
            break
        state = state.unlock(np.array([best]))
        found.append(best)
    return state, np.array(found, np.int64)
