# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Tests of landmarks of one sub-map that share a motion: a translation, or a rigid one.

With displacements D = B θ of the members the price is price - 2 b'θ + θ'Aθ, b = B's, A = B'JB;
b'A⁻¹b is χ²(3) or χ²(6). All sets that differ from one by a single member are tested at once.

A member that is left out of a test is *free*: unlocked, with a displacement of its own. Would it
be held in place, it would pull at its neighbours, that moved as it did, all the harder the
smoother errors are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.distributions import chi2_quantile, chi2_tail
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.local import Sensitivity
from mapmerge_ros.geometry import Gauge, generators

TRANSLATION, RIGID = 3, 6
"""Degrees of freedom of a common motion, the first columns of the basis."""

RIGID_FACTOR = chi2_quantile(float(chi2_tail(40.0, 3)), 6) / 40.0
"""By how much χ²(6) must be larger than χ²(3) to be as improbable, at p = 1e-8."""

RIDGE = 1e-9
"""Share of the largest information that a motion gets for nothing: landmarks on one line."""


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Testable members of one sub-map."""

    members: Ints
    """(n,) ascending"""
    points: Floats
    """(n, 3) merged landmarks"""
    score: Floats
    """s (n, 3)"""
    information: Floats
    """J (3n, 3n)"""
    basis: Floats
    """B (n, 3, 6) displacement per unit of motion: translation, rotation [1 / size of the map]"""

    @classmethod
    def of_map(cls, state: Sensitivity, points: Floats, k: int) -> Patch:
        """Patch of sub-map k; `points` (tracks, 3) are the merged landmarks."""
        part = state.members.of_map(k)
        own = np.flatnonzero(state.testable()[part])
        at = coordinates(own)
        here = points[state.members.tracks[part.start + own]]
        centred = here - here.mean(axis=0) if len(own) else here
        size = np.sqrt(np.mean(centred**2)) if len(own) else 1.0
        return cls(
            part.start + own,
            here,
            state.score[part.start + own],
            state.within[k][np.ix_(at, at)],
            generators(centred, Gauge.RIGID) / np.array([1.0] * 3 + [max(size, 1e-12)] * 3),
        )

    def __len__(self) -> int:
        return len(self.members)

    def rows(self, members: Ints) -> Ints:
        """Rows in this patch of members that it has."""
        return np.searchsorted(self.members, members)

    def only(self, rows: Ints) -> Patch:
        """The members in some rows (m,): of their tests it has all that they need."""
        at = coordinates(rows)
        return Patch(
            self.members[rows],
            self.points[rows],
            self.score[rows],
            self.information[np.ix_(at, at)],
            self.basis[rows],
        )

    def statistic(self, inside: Ints, motion: int) -> float:
        """Test of the members in rows `inside` having one motion in common."""
        total, matrix, _ = self._sums(inside, motion)
        return float(_squares(total, matrix))

    def with_one_more(self, inside: Ints, outside: Ints, motion: int) -> Floats:
        """Statistic with each of the rows `outside` (o,) as well."""
        total, matrix, _ = self._sums(inside, motion)
        basis = self.basis[outside, :, :motion]
        crossing = basis.swapaxes(1, 2) @ self._pushed(outside, inside, motion)
        matrices = matrix + crossing + crossing.swapaxes(1, 2) + self._own(outside, motion)
        return _squares(total + self._scores(outside, motion), matrices)

    def with_one_less(self, inside: Ints, motion: int) -> Floats:
        """Statistic without each of the rows `inside` (m,)."""
        total, matrix, pushed = self._sums(inside, motion)
        crossing = self.basis[inside, :, :motion].swapaxes(1, 2) @ pushed
        matrices = matrix - crossing - crossing.swapaxes(1, 2) + self._own(inside, motion)
        return _squares(total - self._scores(inside, motion), matrices)

    def with_one_free(self, inside: Ints, motion: int) -> Floats:
        """Statistic of the others with each of the rows `inside` (m,) free."""
        total, matrix, pushed = self._sums(inside, motion)
        inverses = np.linalg.inv(self._blocks(inside))
        return _squares(*_free(total, matrix, self.score[inside], pushed, inverses))

    def without_loudest(self, inside: Ints, motion: int) -> float:
        """Statistic with those free, one in five but two at least, that speak for it most."""
        patch = self.only(inside)
        for _ in range(max(2, -(-len(inside) // 5))):
            everyone = np.arange(len(patch))
            loudest = int(np.argmin(patch.with_one_free(everyone, motion)))
            patch = patch._freed(loudest).only(np.delete(everyone, loudest))
        return patch.statistic(np.arange(len(patch)), motion)

    def neighbourhoods(self, count: int, motions: Sequence[int]) -> tuple[Floats, Ints]:
        """
        Statistics (motions, n) of each member with its neighbours, and their rows (n, count).

        The statistic is the least with one of them free.
        """
        rows = np.asarray(cKDTree(self.points).query(self.points, count)[1], np.int64)
        n, size, widest = len(self), 3 * count, max(motions)
        at = coordinates(rows.ravel()).reshape(n, size)
        near = self.information[at[:, :, None], at[:, None, :]]
        basis = self.basis[rows, :, :widest].reshape(n, size, widest)
        pushed = near @ basis
        matrix = basis.swapaxes(1, 2) @ pushed
        total = (basis.swapaxes(1, 2) @ self.score[rows].reshape(n, size, 1))[:, :, 0]
        totals, matrices = _free(
            total[:, None],
            matrix[:, None],
            self.score[rows],
            pushed.reshape(n, count, 3, widest),
            np.linalg.inv(self._blocks(np.arange(n)))[rows],
        )
        values = [_squares(totals[..., :p], matrices[..., :p, :p]) for p in motions]
        return np.array([each.min(axis=1) for each in values]), rows

    def unbent(self) -> Patch:
        """
        The same tests with every bend of the sub-map free that is quadratic in the coordinates.

        However large: nothing is assumed of the lens but that it bends smoothly.
        """
        scaled = self.points - np.median(self.points, axis=0)
        scaled = scaled / max(float(np.median(np.linalg.norm(scaled, axis=1))), 1e-12)
        first, second = np.triu_indices(3)
        fields = np.column_stack(
            [np.ones(len(self)), scaled, scaled[:, first] * scaled[:, second]]
        )
        bends = np.kron(np.linalg.qr(fields)[0], np.eye(3))
        pushed = self.information @ bends
        values, vectors = np.linalg.eigh(bends.T @ pushed)
        seen = values > RIDGE * values.max(initial=0.0)  # frames cost nothing as it is
        white = vectors[:, seen] / np.sqrt(values[seen])
        root = pushed @ white
        score = root @ (white.T @ (bends.T @ self.score.ravel()))
        return replace(
            self,
            score=self.score - score.reshape(-1, 3),
            information=self.information - root @ root.T,
        )

    def togetherness(self, inside: Ints, count: int) -> float:
        """Share of the `count` nearest of each of the rows `inside` that are inside as well."""
        near = np.asarray(cKDTree(self.points).query(self.points[inside], count + 1)[1])[:, 1:]
        return float(np.isin(near, inside).mean())

    def _freed(self, row: int) -> Patch:
        at = slice(3 * row, 3 * row + 3)
        columns = self.information[:, at]
        solved = np.linalg.solve(columns[at], columns.T)
        return replace(
            self,
            score=self.score - (self.score[row] @ solved).reshape(-1, 3),
            information=self.information - columns @ solved,
        )

    def _blocks(self, rows: Ints) -> Floats:
        """J (m, 3, 3) of each of some rows (m,) with itself."""
        n = len(self)
        return self.information.reshape(n, 3, n, 3)[rows, :, rows, :]

    def _sums(self, inside: Ints, motion: int) -> tuple[Floats, Floats, Floats]:
        """Sums b (p,), A (p, p), and J B (m, 3, p), of and for the members inside."""
        pushed = self._pushed(inside, inside, motion)
        basis = self.basis[inside, :, :motion].reshape(-1, motion)
        matrix = basis.T @ pushed.reshape(-1, motion)
        return self._scores(inside, motion).sum(axis=0), matrix, pushed

    def _pushed(self, rows: Ints, inside: Ints, motion: int) -> Floats:
        """J B (m, 3, p): forces on `rows` (m,) when the members inside have the motion."""
        basis = self.basis[inside, :, :motion].reshape(-1, motion)
        forces = self.information[np.ix_(coordinates(rows), coordinates(inside))] @ basis
        return np.asarray(forces.reshape(len(rows), 3, motion))

    def _scores(self, rows: Ints, motion: int) -> Floats:
        """B_i's_i (m, p)."""
        return np.asarray((self.score[rows, None, :] @ self.basis[rows, :, :motion])[:, 0])

    def _own(self, rows: Ints, motion: int) -> Floats:
        """B_i'J_iiB_i (m, p, p)."""
        basis = self.basis[rows, :, :motion]
        return np.asarray(basis.swapaxes(1, 2) @ self._blocks(rows) @ basis)


def _free(
    total: Floats, matrix: Floats, score: Floats, pushed: Floats, inverses: Floats
) -> tuple[Floats, Floats]:
    """
    Sums b (..., m, p) and A (..., m, p, p) of a motion of m members with each of them free.

    b and A of all of them; their s (..., m, 3), J B (..., m, 3, p) and J_ii⁻¹ (..., m, 3, 3).
    A displacement of its own takes up whatever share of the motion the member has.
    """
    solved = inverses @ pushed
    return (
        total - (score[..., None, :] @ solved)[..., 0, :],
        matrix - pushed.swapaxes(-1, -2) @ solved,
    )


def _squares(vectors: Floats, matrices: Floats) -> Floats:
    """
    Squares b'A⁻¹b of (..., p) and (..., p, p).

    Eliminated all at once: thousands of small systems cost LAPACK ten times as much.

    Raises
    ------
    numpy.linalg.LinAlgError
        One of them is singular.

    """
    size = vectors.shape[-1]
    rest = np.empty((size, size + 1, *vectors.shape[:-1]))
    rest[:, :size] = np.moveaxis(matrices, (-2, -1), (0, 1))
    rest[:, size] = np.moveaxis(vectors, -1, 0)
    every = np.arange(size)
    rest[every, every] += RIDGE * rest[every, every].max(axis=0)
    squares = np.zeros(vectors.shape[:-1])
    for k in range(size):
        if not np.all(rest[k, k]):
            raise np.linalg.LinAlgError('a common motion is not determined')
        row = rest[k, k:] / rest[k, k]
        squares += row[-1] * rest[k, size]
        rest[k + 1 :, k + 1 :] -= rest[k + 1 :, k, None] * row[1:]
    return squares
