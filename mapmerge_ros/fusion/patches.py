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
        at = (3 * own[:, None] + np.arange(3)).ravel()
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

    def statistic(self, inside: Ints, motion: int) -> float:
        """Test of the members in rows `inside` having one motion in common."""
        total, matrix, _ = self._sums(inside, motion)
        return float(_squares(total, matrix))

    def with_one_more(self, inside: Ints, outside: Ints, motion: int) -> Floats:
        """Statistic with each of the rows `outside` (o,) as well."""
        total, matrix, pushed = self._sums(inside, motion)
        basis = self.basis[outside, :, :motion]
        crossing = basis.swapaxes(1, 2) @ pushed[outside]
        matrices = matrix + crossing + crossing.swapaxes(1, 2) + self._own(outside, motion)
        return _squares(total + self._scores(outside, motion), matrices)

    def with_one_less(self, inside: Ints, motion: int) -> Floats:
        """Statistic without each of the rows `inside` (m,)."""
        total, matrix, pushed = self._sums(inside, motion)
        crossing = self.basis[inside, :, :motion].swapaxes(1, 2) @ pushed[inside]
        matrices = matrix - crossing - crossing.swapaxes(1, 2) + self._own(inside, motion)
        return _squares(total - self._scores(inside, motion), matrices)

    def with_one_free(self, inside: Ints, motion: int) -> Floats:
        """Statistic of the others with each of the rows `inside` (m,) free."""
        total, matrix, pushed = self._sums(inside, motion)
        return self._free(total, matrix, pushed[inside], inside, motion)

    def without_loudest(self, inside: Ints, motion: int) -> float:
        """Statistic with those free, one in five but two at least, that speak for it most."""
        patch = self
        for _ in range(max(2, -(-len(inside) // 5))):
            at = int(np.argmin(patch.with_one_free(inside, motion)))
            patch, inside = patch._freed(int(inside[at])), np.delete(inside, at)
        return patch.statistic(inside, motion)

    def neighbourhoods(self, count: int, motions: Sequence[int]) -> tuple[Floats, Ints]:
        """
        Statistics (motions, n) of each member with its neighbours, and their rows (n, count).

        The statistic is the least with one of them free.
        """
        rows = np.asarray(cKDTree(self.points).query(self.points, count)[1], np.int64)
        n, size, widest = len(self), 3 * count, max(motions)
        blocks = self.information.reshape(n, 3, n, 3).swapaxes(1, 2)
        near = blocks[rows[:, :, None], rows[:, None, :]].swapaxes(2, 3).reshape(n, size, size)
        basis = self.basis[rows, :, :widest].reshape(n, size, widest)
        pushed = near @ basis
        matrix = basis.swapaxes(1, 2) @ pushed
        total = (basis.swapaxes(1, 2) @ self.score[rows].reshape(n, size, 1))[:, :, 0]
        pushed = pushed.reshape(n, count, 3, widest)
        values = [
            self._free(total[:, None, :p], matrix[:, None, :p, :p], pushed[..., :p], rows, p)
            for p in motions
        ]
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

    def _free(
        self, total: Floats, matrix: Floats, pushed: Floats, rows: Ints, motion: int
    ) -> Floats:
        """
        Statistics (..., m) of a motion of the members in `rows` (..., m) with each of them free.

        b (..., p) and A (..., p, p) are of all of them, J B (..., m, 3, p) by member.
        """
        basis, own = self.basis[:, :, :motion], self._blocks()
        alone = own @ basis
        crossing = basis.swapaxes(1, 2)[rows] @ pushed
        rest = matrix - crossing - crossing.swapaxes(-1, -2) + self._own(rows, motion)
        left = total - self._scores(rows, motion)
        towards = pushed - alone[rows]
        some, back = np.unique(rows, return_inverse=True)  # what is free already has no inverse
        solved = np.linalg.inv(own[some])[back.reshape(rows.shape)] @ towards
        return _squares(
            left - (self.score[rows][..., None, :] @ solved)[..., 0, :],
            rest - towards.swapaxes(-1, -2) @ solved,
        )

    def _freed(self, row: int) -> Patch:
        at = slice(3 * row, 3 * row + 3)
        columns = self.information[:, at]
        solved = np.linalg.solve(columns[at], columns.T)
        return replace(
            self,
            score=self.score - (self.score[row] @ solved).reshape(-1, 3),
            information=self.information - columns @ solved,
        )

    def _blocks(self) -> Floats:
        """J (n, 3, 3) of each with itself."""
        n = len(self)
        every = np.arange(n)
        return self.information.reshape(n, 3, n, 3)[every, :, every, :]

    def _sums(self, inside: Ints, motion: int) -> tuple[Floats, Floats, Floats]:
        """Sums b (p,), A (p, p), and J B (n, 3, p), of the members inside."""
        at = (3 * inside[:, None] + np.arange(3)).ravel()
        basis = self.basis[inside, :, :motion].reshape(-1, motion)
        pushed = self.information[:, at] @ basis
        matrix = basis.T @ pushed[at]
        total = self._scores(inside, motion).sum(axis=0)
        return total, matrix, pushed.reshape(len(self), 3, motion)

    def _scores(self, rows: Ints, motion: int) -> Floats:
        """B_i's_i (..., p)."""
        scores = (self.score[:, None, :] @ self.basis[:, :, :motion])[:, 0]
        return np.asarray(scores[rows])

    def _own(self, rows: Ints, motion: int) -> Floats:
        """B_i'J_iiB_i (..., p, p)."""
        basis = self.basis[:, :, :motion]
        return np.asarray((basis.swapaxes(1, 2) @ self._blocks() @ basis)[rows])


def _squares(vectors: Floats, matrices: Floats) -> Floats:
    """Squares b'A⁻¹b of (..., p) and (..., p, p)."""
    size = vectors.shape[-1]
    scale = np.einsum('...ii->...i', matrices).max(axis=-1)
    held = matrices + RIDGE * scale[..., None, None] * np.eye(size)
    return np.asarray(np.sum(vectors * np.linalg.solve(held, vectors[..., None])[..., 0], axis=-1))
