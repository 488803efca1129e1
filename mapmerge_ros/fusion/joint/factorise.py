# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Multifrontal Cholesky: one dense partial factorisation per front (Duff & Reid 1983).

Only lower triangles are valid. Arrays are in Fortran order, so that LAPACK works in place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.blas import add_square, mirror, times_lower
from mapmerge_ros.fusion.joint.factor import Block, Factor
from mapmerge_ros.fusion.joint.fronts import Front, Fronts
from mapmerge_ros.fusion.joint.stacks import Stacks

Elements = Callable[[int, Ints, Floats], None]
"""
Writes the lower triangle of the symmetric matrix of one sub-map, its landmarks in a given order.

The target (3s, 3s) is in Fortran order; what is above its diagonal does not matter.
"""


SMALL = 64
"""Size up to which a triangle is inverted as a whole."""

STRIP = 128
"""Columns that are cleared at a time: what is above the diagonal need not be."""


def factorise(
    fronts: Fronts,
    elements: Elements,
    *,
    keep_root: bool = False,
    dtype: type[np.floating[Any]] = np.float64,
    storage: Floats | None = None,
) -> Factor:
    """
    Factorise the sum of the elements; with `keep_root` all but the landmarks at the root.

    Everything is computed in float64; `dtype` is how the factor is kept. `storage` is that of a
    factor of the same fronts which is not needed any more.

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not positive definite.

    """
    blocks: list[Block] = []
    updates: dict[int, Floats] = {}
    stacks = Stacks.of(fronts)
    storage = np.empty(fronts.storage, dtype) if storage is None else storage
    exact = storage.dtype == np.float64
    scratch = storage if exact else np.empty(fronts.largest)
    used = 0
    for node, front in enumerate(fronts.fronts):
        start = used if exact else 0
        made = Block.at(front, scratch, start)
        pivot, below = made.inverse, made.below
        kept = made if exact else Block.at(front, storage, used)
        used += len(front.rows) * front.eliminated
        rest = stacks.push(front.depth, len(below))
        if front.leaf >= 0:
            _place(front, elements, pivot, below, rest)
        else:
            with np.errstate(all='ignore'):  # what nobody looks at may be infinite
                _assemble(front, updates, pivot, below, rest)
            stacks.pop(front.depth + 1, [len(updates.pop(child)) for child in front.children])
        if keep_root and node == len(fronts.fronts) - 1:
            root = pivot.copy(order='F')
            mirror(root)
            return Factor(fronts, tuple(blocks), storage, root)
        _eliminate(pivot, below, rest)
        if not exact:
            kept.inverse[...], kept.below[...] = pivot, below
        blocks.append(kept)
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
    below[...] = 0.0
    for part in (pivot, rest):
        for column in range(0, len(part), STRIP):
            part[column:, column : column + STRIP] = 0.0
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
    _invert(pivot)
    if len(below):
        # A product with the inverse is three times as fast as a triangular solve, here and later.
        times_lower(below, pivot, transposed=True, right=True)
        add_square(rest, below, -1.0)


def _invert(matrix: Floats) -> None:
    """
    Inverse of the Cholesky factor of a matrix (k, k), in its place; zero above the diagonal.

    By halves, since LAPACK's inverse of a small triangle is slow: [A; B C] becomes
    [A⁻¹; -C⁻¹B A⁻¹, C⁻¹].
    """
    if len(matrix) <= SMALL:
        factor, failed = dpotrf(matrix, lower=1, clean=1)
        if failed or not np.isfinite(np.diag(factor)).all():
            raise np.linalg.LinAlgError('a front is not positive definite')
        matrix[...] = dtrtri(factor, lower=1, overwrite_c=1)[0]
        return
    half = len(matrix) // 2
    first, lower, second = matrix[:half, :half], matrix[half:, :half], matrix[half:, half:]
    _invert(first)
    times_lower(lower, first, transposed=True, right=True)
    add_square(second, lower, -1.0)
    _invert(second)
    times_lower(lower, second, -1.0)
    times_lower(lower, first, right=True)
    matrix[:half, half:] = 0.0
