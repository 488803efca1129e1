# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The factor of a sum of elements, front by front: solving with it, and parts of its inverse."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg.blas import dtrmv, strmm, strmv

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.blas import mirror, square_of_lower, times_lower
from mapmerge_ros.fusion.joint.fronts import Front, Fronts, Run
from mapmerge_ros.fusion.joint.trust import Trust

LARGEST_KEPT = 2**26
"""Numbers of a factor and its leaves that are kept for the next merge: 0.25 GB, 300 drones."""

PATIENCE = 3
"""Steps before it is asked how they get on: two show a rate, and one of these may overshoot."""

OVERSHOOT = 10.0
"""
By how many times its promise a step with an old factor may raise the cost.

Old and new matrix differ in the soft modes, and what a step along them shows (`Acceleration`) is
worth more than the rise.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """What elimination at one front leaves: [L 0; M I] times its transpose."""

    inverse: Floats
    """L⁻¹ (k, k)"""
    below: Floats
    """M (b, k)"""

    @classmethod
    def at(cls, front: Front, memory: Floats, start: int) -> Block:
        """Block of a front in its place of a memory, both parts in Fortran order."""
        n, k = len(front.rows), front.eliminated
        middle, stop = start + k * k, start + n * k
        return cls(
            memory[start:middle].reshape((k, k), order='F'),
            memory[middle:stop].reshape((n - k, k), order='F'),
        )


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
    leaves: dict[int, Floats] = field(default_factory=dict)
    """
    Per sub-map the inverse on the shared rows of its front, a packed triangle, where known
    """

    @property
    def fits(self) -> bool:
        """Whether it is small enough to be kept until the next merge, with its leaves."""
        return len(self.storage) + self.fronts.triangles <= LARGEST_KEPT

    @property
    def trust(self) -> Trust:
        """Say how long to go on with it."""
        return Trust(self.fronts.worth, PATIENCE, OVERSHOOT)

    def rounded(self, scale: float, leaves: dict[int, Floats]) -> Factor:
        """
        Copy in float32, without what is left at the root: for steps of a later merge.

        It is the factor of the matrix times the square of `scale`; `leaves` are of that one too.
        """
        storage, blocks, used = np.empty(len(self.storage), np.float32), list[Block](), 0
        for front, exact in zip(self.fronts.fronts, self.blocks, strict=False):
            block = Block.at(front, storage, used)
            # Without noise `scale` is far below what float32 can hold; the quotient is not.
            block.inverse[...], block.below[...] = exact.inverse / scale, exact.below * scale
            blocks.append(block)
            used += len(front.rows) * front.eliminated
        return Factor(self.fronts, tuple(blocks), storage, leaves=leaves)

    def solve(self, right: Floats, change: Change | None = None) -> Floats:
        """Solve for right-hand sides (size, m), with the matrix as it is after a change."""
        solved = self._sorted(right)
        self._forward(solved)
        if change:
            moved, answer = solved.copy(order='F'), np.zeros_like(solved)
            self._backward(moved, change.path)
            answer[change.places] = change.response @ moved[change.places]
            self._forward(answer)
            solved -= answer
        self._backward(solved, range(len(self.blocks)))
        return self._unsorted(solved, right)

    def forward(self, right: Floats) -> Floats:
        """Eliminate: rows of eliminated coordinates are L⁻¹ right, the others what is left."""
        solved = self._sorted(right)
        self._forward(solved)
        return self._unsorted(solved, right)

    def _sorted(self, right: Floats) -> Floats:
        columns = right.reshape(len(right), -1)[self.fronts.order]
        return np.asfortranarray(columns, self.storage.dtype)

    def _unsorted(self, solved: Floats, right: Floats) -> Floats:
        answer = np.empty(solved.shape)
        answer[self.fronts.order] = solved
        return answer.reshape(right.shape)

    def _forward(self, solved: Floats) -> None:
        for front, block in zip(self.fronts.fronts, self.blocks, strict=False):
            if front.eliminated:
                own = slice(front.start, front.start + front.eliminated)
                if not solved[own].any():
                    continue  # what one map says goes from its leaf to the root, and nowhere else
                _times_lower(solved[own], block.inverse)
                if len(front.boundary):
                    solved[front.boundary] -= block.below @ solved[own]

    def _backward(self, solved: Floats, nodes: Sequence[int]) -> None:
        """Solve for what these fronts eliminate: with a front, all above it."""
        for node in reversed(nodes):
            front, block = self.fronts.fronts[node], self.blocks[node]
            if front.eliminated:
                own = slice(front.start, front.start + front.eliminated)
                if len(front.boundary):
                    solved[own] -= block.below.T @ solved[front.boundary]
                _times_lower(solved[own], block.inverse, transposed=True)

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


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """
    What another matrix of one sub-map does to the inverse (Woodbury 1950).

    With A = L L' + E D E', E the columns of the sub-map and S = E' (L L')^-1 E,
    A^-1 g = (L L')^-1 (g - E D (1 + S D)^-1 E' (L L')^-1 g).
    """

    path: Sequence[int]
    """Fronts from that of the sub-map up to the root"""
    places: Ints
    """(m,) places of the sub-map's coordinates in the order of elimination"""
    response: Floats
    """(m, m) D (1 + S D)^-1"""


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """A factor that was made for another numbering of the landmarks, perhaps with others."""

    factor: Factor
    numbers: Ints
    """(tracks,) number of each landmark in the factor"""
    change: Change | None = None
    """Of one sub-map, since then"""
    scale: float = 1.0
    """What all of it counts now, over what it counted then"""

    @property
    def trust(self) -> Trust:
        """Say how long to go on with it."""
        return self.factor.trust

    def solve(self, right: Floats) -> Floats:
        """Solve for a right-hand side (3 tracks,); what is gone has none."""
        old = np.zeros((self.factor.fronts.size // 3, 3))
        old[self.numbers] = right.reshape(-1, 3)
        solved = self.factor.solve(old.ravel(), self.change)
        return solved.reshape(-1, 3)[self.numbers].ravel() / self.scale


def _times_lower(right: Floats, lower: Floats, *, transposed: bool = False) -> None:
    """Lower triangle or its transpose times (k, m), in its place."""
    exact = lower.dtype == np.float64
    if right.shape[1] == 1:
        multiply = dtrmv if exact else strmv
        right[:, 0] = multiply(lower, right[:, 0], lower=1, trans=transposed)
    elif exact:
        times_lower(right, lower, transposed=transposed)
    else:
        right[...] = strmm(1.0, lower, right, lower=1, trans_a=transposed)


def _inverse(block: Block, boundary: Floats) -> Floats:
    """Inverse (k + b, k + b) of a front from that of its boundary (b, b), both full."""
    k, b = len(block.inverse), len(boundary)
    inverse = np.empty((k + b, k + b), order='F')
    own = block.inverse.copy(order='F')
    square_of_lower(own)
    mirror(own)
    if b:
        coupling = block.below.copy(order='F')
        times_lower(coupling, block.inverse, right=True)
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
