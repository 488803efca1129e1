# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Multifrontal Cholesky: one dense partial factorisation per front (Duff & Reid 1983).

Only lower triangles are valid. Arrays are in Fortran order, so that LAPACK works in place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dsyrk, dtrsm, dtrsv
from scipy.linalg.lapack import dpotrf, dpotri

from mapmerge_ros.arrays import Floats
from mapmerge_ros.fusion.joint.fronts import Front, Fronts, Run

Elements = Callable[[int], Floats]
"""The symmetric matrix of one sub-map, its landmarks in the sub-map's own order."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """What elimination at one front leaves: [L 0; M I] times its transpose."""

    diagonal: Floats
    """L (k, k)"""
    below: Floats
    """M (b, k)"""


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """Cholesky factor of the sum of all elements."""

    fronts: Fronts
    blocks: tuple[Block, ...]
    """Per front; where the root is kept it has none"""
    root: Floats | None = None
    """(n, n) what is left of the matrix for the rows of the root's front, when kept"""

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (size, m)."""
        return self.backward(self.forward(right))

    def forward(self, right: Floats) -> Floats:
        """Eliminate: rows of eliminated coordinates are L⁻¹ right, the others what is left."""
        solved = np.array(right.reshape(len(right), -1), order='F')
        for front, block in zip(self.fronts.fronts, self.blocks, strict=False):
            k = front.eliminated
            if not k:
                continue
            own = _solve_lower(block.diagonal, solved[front.rows[:k]])
            solved[front.rows[:k]] = own
            solved[front.rows[k:]] -= block.below @ own
        return solved.reshape(right.shape)

    def backward(self, right: Floats) -> Floats:
        """Substitute back from the root to the leaves."""
        solved = right.reshape(len(right), -1).copy(order='F')
        for front, block in zip(reversed(self._eliminating()), reversed(self.blocks), strict=True):
            k = front.eliminated
            if not k:
                continue
            own = solved[front.rows[:k]] - block.below.T @ solved[front.rows[k:]]
            solved[front.rows[:k]] = _solve_lower(block.diagonal, own, transposed=1)
        return solved.reshape(right.shape)

    def inverse_blocks(self) -> Iterator[tuple[Front, Floats]]:
        """
        Blocks (k + b, k + b) of the inverse, one front after the other, parents first.

        The inverse is only formed where the factor is not zero (Takahashi et al. 1973; Erisman &
        Tinney 1975).
        """
        waiting: dict[int, Floats] = {}
        for node in range(len(self.blocks) - 1, -1, -1):
            front, block = self.fronts.fronts[node], self.blocks[node]
            boundary = waiting.pop(node, np.zeros((0, 0)))
            inverse = _inverse(block, boundary) if front.eliminated else boundary
            for child, runs in zip(front.children, front.runs, strict=True):
                waiting[child] = _pick(inverse, runs)
            yield front, inverse

    def _eliminating(self) -> tuple[Front, ...]:
        return self.fronts.fronts[: len(self.blocks)]


def factorise(fronts: Fronts, elements: Elements, *, keep_root: bool = False) -> Factor:
    """
    Factorise the sum of the elements; with `keep_root` all but the landmarks at the root.

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not positive definite.

    """
    blocks: list[Block] = []
    updates: dict[int, Floats] = {}
    for node, front in enumerate(fronts.fronts):
        k = front.eliminated
        if front.leaf >= 0:
            own = elements(front.leaf)[np.ix_(front.leaf_order, front.leaf_order)].T
            parts = own[:k, :k], own[k:, :k], own[k:, k:]
            pivot, below, rest = (np.asfortranarray(part) for part in parts)
        else:
            pivot, below, rest = _assemble(front, updates)
        if keep_root and node == len(fronts.fronts) - 1:
            return Factor(fronts, tuple(blocks), np.tril(pivot) + np.tril(pivot, -1).T)
        block, updates[node] = _eliminate(pivot, below, rest)
        blocks.append(block)
    return Factor(fronts, tuple(blocks))


def _assemble(front: Front, updates: dict[int, Floats]) -> tuple[Floats, Floats, Floats]:
    """Sum of what the children leave (extend-add), as pivot, below and rest."""
    k, b = front.eliminated, len(front.rows) - front.eliminated
    pivot, below, rest = (np.zeros(n, order='F') for n in ((k, k), (b, k), (b, b)))
    for child, runs in zip(front.children, front.runs, strict=True):
        update = updates.pop(child)
        for j, (start, stop, column) in enumerate(runs):
            width = slice(column, column + stop - start)
            for low, high, row in runs[j:]:
                part = update[low:high, start:stop]
                end = row + high - low
                if row < k:
                    pivot[row:end, width] += part
                elif column < k:
                    below[row - k : end - k, width] += part
                else:
                    rest[row - k : end - k, column - k : width.stop - k] += part
    return pivot, below, rest


def _eliminate(pivot: Floats, below: Floats, rest: Floats) -> tuple[Block, Floats]:
    if not len(pivot):
        return Block(pivot, below), rest
    diagonal, failed = dpotrf(pivot, lower=1, clean=1, overwrite_a=1)
    if failed or not np.isfinite(np.diag(diagonal)).all():
        raise np.linalg.LinAlgError('a front is not positive definite')
    if len(below):
        below = dtrsm(1.0, diagonal, below, side=1, lower=1, trans_a=1, overwrite_b=1)
        rest = dsyrk(-1.0, below, beta=1.0, c=rest, lower=1, overwrite_c=1)
    return Block(diagonal, below), rest


def _solve_lower(lower: Floats, right: Floats, transposed: int = 0) -> Floats:
    """L⁻¹ or L'⁻¹ times right-hand sides (k, m)."""
    if right.shape[1] == 1:
        return np.asarray(dtrsv(lower, right[:, 0], lower=1, trans=transposed))[:, None]
    return np.asarray(dtrsm(1.0, lower, right, lower=1, trans_a=transposed))


def _inverse(block: Block, boundary: Floats) -> Floats:
    """Inverse (k + b, k + b) of a front from that of its boundary (b, b), both full."""
    k, b = len(block.diagonal), len(boundary)
    inverse = np.empty((k + b, k + b), order='F')
    lower = dpotri(block.diagonal, lower=1)[0]
    own = lower + lower.T
    own[range(k), range(k)] *= 0.5
    if b:
        coupling = dtrsm(1.0, block.diagonal, block.below, side=1, lower=1)
        pulled = boundary @ coupling
        own += coupling.T @ pulled
        inverse[k:, :k], inverse[:k, k:] = -pulled, -pulled.T
        inverse[k:, k:] = boundary
    inverse[:k, :k] = own
    return inverse


def _pick(matrix: Floats, runs: tuple[Run, ...]) -> Floats:
    """Rows and columns of the runs."""
    size = runs[-1][1] if runs else 0
    picked = np.empty((size, size), order='F')
    for start, stop, column in runs:
        for low, high, row in runs:
            part = matrix[row : row + high - low, column : column + stop - start]
            picked[low:high, start:stop] = part
    return picked
