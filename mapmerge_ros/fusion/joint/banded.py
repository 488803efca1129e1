# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Symmetric matrices with one small block per pair of neighbours, solved by their band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.sparse.csgraph import reverse_cuthill_mckee

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.geometry import sparse_graph


@dataclass(frozen=True, slots=True, eq=False)
class Banded:
    """Cholesky factor of a matrix whose rows are in the order of Cuthill & McKee (1969)."""

    places: Ints
    """(count, b) row of each unknown in that order"""
    factor: Floats
    """(bandwidth + 1, count b) lower"""

    @classmethod
    def of(
        cls, rows: Ints, columns: Ints, blocks: Floats, count: int, *, growth: float = 0.0
    ) -> Banded:
        """
        Factorise the sum of blocks (p, b, b), each at its place in a matrix of count x count.

        The diagonal grows by a share of itself.

        Raises
        ------
        numpy.linalg.LinAlgError
            It is not positive definite.

        """
        width = blocks.shape[1]
        graph = sparse_graph(np.ones(len(rows)), rows, columns, count)
        rank = np.empty(count, np.int64)
        rank[reverse_cuthill_mckee(graph, symmetric_mode=True)] = np.arange(count)
        half = rank[rows] >= rank[columns]  # the others say the same
        rows, columns, blocks = rows[half], columns[half], blocks[half]
        places = width * rank[:, None] + np.arange(width)
        row, column = places[rows][:, :, None], places[columns][:, None, :]
        below = row - column
        lower = below >= 0
        height = int(below.max(initial=0)) + 1
        flat = (below + height * column)[lower]
        size = count * width
        band = np.bincount(flat, weights=blocks[lower], minlength=height * size)
        matrix = band.reshape((height, size), order='F')
        matrix[0] *= 1.0 + growth
        factor = scipy.linalg.cholesky_banded(
            matrix, overwrite_ab=True, lower=True, check_finite=False
        )
        return cls(places, factor)

    def solve(self, right: Floats) -> Floats:
        """Solve for a right-hand side (count, b)."""
        moved = np.empty(right.size)
        moved[self.places] = right
        solved = scipy.linalg.cho_solve_banded(
            (self.factor, True), moved, overwrite_b=True, check_finite=False
        )
        return np.asarray(solved[self.places])
