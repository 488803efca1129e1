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
from scipy.linalg.blas import dsyrk, dtrmm, dtrmv
from scipy.linalg.lapack import dlauum, dpotrf, dtrtri

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.joint.fronts import Front, Fronts, Run
from mapmerge_ros.fusion.joint.stacks import Stacks

Elements = Callable[[int, Ints, Floats], None]
"""
Writes the lower triangle of the symmetric matrix of one sub-map, its landmarks in a given order.

The target (3s, 3s) is in Fortran order; what is above its diagonal does not matter.
"""


LARGEST_KEPT = 2**26
"""Numbers of a factor that is kept for the next merge: 0.5 GB, and some 300 drones."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """What elimination at one front leaves: [L 0; M I] times its transpose."""

    inverse: Floats
    """L⁻¹ (k, k)"""
    below: Floats
    """M (b, k)"""


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """Cholesky factor of the sum of all elements."""

    fronts: Fronts
    blocks: tuple[Block, ...]
    """Per front; where the root is kept it has none"""
    storage: Floats
    """Where the blocks lie"""
    root: Floats | None = None
    """(n, n) what is left of the matrix for the rows of the root's front, when kept"""

    @property
    def fits(self) -> bool:
        """Whether it is small enough to be kept until the next merge."""
        return len(self.storage) <= LARGEST_KEPT

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides (size, m)."""
        solved = self._sorted(right)
        self._forward(solved)
        self._backward(solved)
        return self._unsorted(solved, right)

    def forward(self, right: Floats) -> Floats:
        """Eliminate: rows of eliminated coordinates are L⁻¹ right, the others what is left."""
        solved = self._sorted(right)
        self._forward(solved)
        return self._unsorted(solved, right)

    def _sorted(self, right: Floats) -> Floats:
        return np.asfortranarray(right.reshape(len(right), -1)[self.fronts.order])

    def _unsorted(self, solved: Floats, right: Floats) -> Floats:
        answer = np.empty_like(solved)
        answer[self.fronts.order] = solved
        return answer.reshape(right.shape)

    def _forward(self, solved: Floats) -> None:
        for front, block in zip(self.fronts.fronts, self.blocks, strict=False):
            if front.eliminated:
                own = slice(front.start, front.start + front.eliminated)
                solved[own] = _times_lower(block.inverse, solved[own])
                if len(front.boundary):
                    solved[front.boundary] -= block.below @ solved[own]

    def _backward(self, solved: Floats) -> None:
        fronts = self.fronts.fronts[: len(self.blocks)]
        for front, block in zip(reversed(fronts), reversed(self.blocks), strict=True):
            if front.eliminated:
                own = slice(front.start, front.start + front.eliminated)
                right = solved[own]
                if len(front.boundary):
                    right = right - block.below.T @ solved[front.boundary]
                solved[own] = _times_lower(block.inverse, right, transposed=1)

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


def factorise(
    fronts: Fronts,
    elements: Elements,
    *,
    keep_root: bool = False,
    storage: Floats | None = None,
) -> Factor:
    """
    Factorise the sum of the elements; with `keep_root` all but the landmarks at the root.

    `storage` is that of a factor of the same fronts which is not needed any more.

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not positive definite.

    """
    blocks: list[Block] = []
    updates: dict[int, Floats] = {}
    stacks = Stacks.of(fronts)
    storage = np.empty(fronts.storage) if storage is None else storage
    used = 0
    for node, front in enumerate(fronts.fronts):
        n, k = len(front.rows), front.eliminated
        pivot = storage[used : used + k * k].reshape((k, k), order='F')
        below = storage[used + k * k : used + n * k].reshape((n - k, k), order='F')
        used += n * k
        rest = stacks.push(front.depth, n - k)
        if front.leaf >= 0:
            _place(front, elements, pivot, below, rest)
        else:
            with np.errstate(all='ignore'):  # what nobody looks at may be infinite
                _assemble(front, updates, pivot, below, rest)
            stacks.pop(front.depth + 1, [len(updates.pop(child)) for child in front.children])
        if keep_root and node == len(fronts.fronts) - 1:
            root = np.tril(pivot) + np.tril(pivot, -1).T
            return Factor(fronts, tuple(blocks), storage, root)
        _eliminate(pivot, below, rest)
        blocks.append(Block(pivot, below))
        updates[node] = rest
    return Factor(fronts, tuple(blocks), storage)


def _place(front: Front, elements: Elements, pivot: Floats, below: Floats, rest: Floats) -> None:
    """Element of a leaf as pivot, below and rest."""
    k, n = len(pivot), len(front.rows)
    if not k:
        elements(front.leaf, front.leaf_order, rest)
        return
    whole = np.zeros((n, n), order='F')
    elements(front.leaf, front.leaf_order, whole)
    pivot[...], below[...], rest[...] = whole[:k, :k], whole[k:, :k], whole[k:, k:]


def _assemble(
    front: Front, updates: dict[int, Floats], pivot: Floats, below: Floats, rest: Floats
) -> None:
    """Sum of what the children leave (extend-add), as pivot, below and rest."""
    k = len(pivot)
    for part in (pivot, below, rest):
        part[...] = 0.0
    for child, runs in zip(front.children, front.runs, strict=True):
        update = updates[child]
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


def _eliminate(pivot: Floats, below: Floats, rest: Floats) -> None:
    """In place: pivot becomes L⁻¹, below M, rest what is left."""
    if not len(pivot):
        return
    _, failed = dpotrf(pivot, lower=1, clean=1, overwrite_a=1)
    if failed or not np.isfinite(np.diag(pivot)).all():
        raise np.linalg.LinAlgError('a front is not positive definite')
    # A product with the inverse is three times as fast as a triangular solve, here and later.
    dtrtri(pivot, lower=1, overwrite_c=1)
    if len(below):
        dtrmm(1.0, pivot, below, side=1, lower=1, trans_a=1, overwrite_b=1)
        dsyrk(-1.0, below, beta=1.0, c=rest, lower=1, overwrite_c=1)


def _times_lower(lower: Floats, right: Floats, transposed: int = 0) -> Floats:
    """Lower triangle or its transpose times (k, m)."""
    if right.shape[1] == 1:
        return np.asarray(dtrmv(lower, right[:, 0], lower=1, trans=transposed))[:, None]
    return np.asarray(dtrmm(1.0, lower, right, lower=1, trans_a=transposed))


def _inverse(block: Block, boundary: Floats) -> Floats:
    """Inverse (k + b, k + b) of a front from that of its boundary (b, b), both full."""
    k, b = len(block.inverse), len(boundary)
    inverse = np.empty((k + b, k + b), order='F')
    lower = np.tril(dlauum(block.inverse, lower=1)[0])
    own = lower + lower.T
    own[range(k), range(k)] *= 0.5
    if b:
        coupling = dtrmm(1.0, block.inverse, block.below, side=1, lower=1)
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
