# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""R of one sub-map as it came: packed, so that there is one copy of it, half a matrix large."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dtpmv

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

    def dense(self) -> Floats:
        """R (k, 3s) in float64, not weighted."""
        return unpack(self.packed, self.columns, len(self.c))

    def responses(self, displacement: Floats, scratch: Floats) -> tuple[float, Floats]:
        """
        Cost of a displacement (3s,) and half its derivative (3s,), weighted.

        R is never unpacked: read as a packed triangle it fits the cache, and BLAS does the rest.
        `scratch` is for `scratch_size(columns)` numbers.
        """
        size, count = scratch_size(self.columns), len(self.packed)
        triangle = scratch[:size]
        triangle[:count] = self.packed
        triangle[count:] = 0.0
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
    """Unpacks one R after the other into the same memory: fresh pages cost more than the copy."""

    def __init__(self, columns: int) -> None:
        """`columns` of the largest."""
        self._flat = np.empty(columns**2)
        self._is_upper = np.arange(columns) >= np.arange(columns)[:, None]

    def trapezoid(self, packed: Floats, rows: int, columns: int) -> Floats:
        """R (rows, columns) in float64, valid until the next one."""
        r = self._flat[: rows * columns].reshape(rows, columns)
        r[...] = 0.0
        r[self._is_upper[:rows, :columns]] = packed
        return r


def scratch_size(columns: int) -> int:
    """Numbers in a packed triangle."""
    return columns * (columns + 1) // 2


def _three(rows: Ints) -> Ints:
    return np.asarray((3 * rows[:, None] + np.arange(3)).ravel())
