# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""R of one sub-map as it came: packed, so that there is one copy of it, half a matrix large."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dtpmv
from scipy.linalg.lapack import dtpttr

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.submap import pack, triangulate, unpack


@dataclass(frozen=True, slots=True, eq=False)
class Root:
    """R and c of one sub-map; the squared residuals count `weight` times."""

    packed: Floats
    """R (k, 3s), an upper trapezoid, row by row; float32 where it came so: that is exact"""
    c: Floats
    """(k,)"""
    weight: float
    columns: int
    """3s"""

    @property
    def size(self) -> float:
        """Sum of the squares of R, weighted."""
        return self.weight * float(np.vdot(self.packed, self.packed))

    def dense(self) -> Floats:
        """R (k, 3s) in float64, not weighted."""
        return unpack(self.packed, self.columns, len(self.c))

    def responses(self, displacement: Floats, scratch: Floats) -> tuple[float, Floats]:
        """
        Cost of a displacement (3s,) and half its derivative (3s,), weighted.

        R is never unpacked: read as a packed triangle it fits the cache, and BLAS does the rest.
        `scratch` is for `scratch_size(columns)` numbers.
        """
        triangle = in_scratch(self.packed, self.columns, scratch)
        # Rows of an upper triangle are the columns of its transpose.
        residuals = dtpmv(self.columns, triangle, displacement, lower=1, trans=1)
        residuals[: len(self.c)] += self.c
        cost = self.weight * float(residuals @ residuals)
        slopes = dtpmv(self.columns, triangle, residuals, lower=1, trans=0, overwrite_x=1)
        slopes *= self.weight
        return cost, slopes

    def without(self, is_shared: Mask) -> Root:
        """Private columns first in a QR: the rows below them hold for every T (exact)."""
        if is_shared.all():
            return self
        private, shared = np.flatnonzero(~is_shared), np.flatnonzero(is_shared)
        order = np.concatenate([private, shared])
        r, c = triangulate(self.dense()[:, _three(order)], self.c)
        below = 3 * len(private)
        return Root(pack(r[below:, below:]), c[below:], self.weight, 3 * len(shared))


class Unpacked:
    """Unpacks one R after the other by way of the same memory."""

    def __init__(self, columns: int) -> None:
        """`columns` of the largest."""
        self._scratch = np.empty(scratch_size(columns))

    def trapezoid(self, packed: Floats, rows: int, columns: int) -> Floats:
        """R (rows, columns) in float64, in memory of its own."""
        triangle = in_scratch(packed, columns, self._scratch)
        # Rows of an upper triangle are the columns of its transpose.
        lower: Floats = dtpttr(columns, triangle, uplo='L')[0]
        return lower.T[:rows]


def in_scratch(packed: Floats, columns: int, scratch: Floats) -> Floats:
    """Packed trapezoid as a packed triangle in float64, in memory that is there already."""
    triangle = scratch[: scratch_size(columns)]
    triangle[: len(packed)] = packed
    triangle[len(packed) :] = 0.0
    return triangle


def scratch_size(columns: int) -> int:
    """Numbers in a packed triangle."""
    return columns * (columns + 1) // 2


def _three(rows: Ints) -> Ints:
    return np.asarray((3 * rows[:, None] + np.arange(3)).ravel())
