# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Upper trapezoids R with R'R = information, and their packed form.

A map with n landmarks and gauge g has information of rank 3n - g; R has that many rows, row i
starting at column i. The packed form is those rows one after the other (DESIGN of the message).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.errors import DegenerateGeometry

UNDETERMINED = 'the information has too small a rank: a landmark is not determined'


def packed_size(rows: int, columns: int) -> int:
    """Length of the packed form of a (rows, columns) upper trapezoid."""
    return rows * columns - rows * (rows - 1) // 2


def pack(trapezoid: Floats) -> Floats:
    """Upper trapezoid (rows, columns) to its packed form."""
    return trapezoid[_upper(*trapezoid.shape)]


def unpack(
    packed: Floats, columns: int, rows: int, dtype: type[np.floating[Any]] = np.float64
) -> Floats:
    """Packed form to the upper trapezoid (rows, columns)."""
    trapezoid = np.zeros((rows, columns), dtype)
    trapezoid[_upper(rows, columns)] = packed
    return trapezoid


def _upper(rows: int, columns: int) -> Mask:
    # A mask is read in C order, which is that of the packed form, ten times faster than indices.
    return np.asarray(np.arange(columns) >= np.arange(rows)[:, None])


def upper_qr(matrix: Floats) -> Floats:
    """Triangular factor of a QR decomposition, the orthogonal one never formed."""
    factor: Any = np.linalg.qr(matrix, mode='r')
    return np.asarray(factor, np.float64)


def triangulate(matrix: Floats, vector: Floats) -> tuple[Floats, Floats]:
    """Upper trapezoid R and c with |matrix x + vector|² = |R x + c|² + const, by QR."""
    rows, columns = matrix.shape
    stacked = np.column_stack([matrix, vector])
    r = upper_qr(stacked)
    kept = min(rows, columns)
    return r[:kept, :columns], r[:kept, columns]


def factor_information(
    information: Floats, gradient: Floats, null_basis: Floats
) -> tuple[Floats, Floats]:
    """
    Upper trapezoid R (n - g, n) and c (n - g,) with R'R = information, R'c = gradient.

    `null_basis` (n, g) is orthonormal and spans the null space of the information. It is added,
    which makes the matrix definite, and rotations take it out of the factor again. To factorise
    the first n - g coordinates alone would be quicker, but puts all errors of rounding where the
    last landmarks hold the frame badly: 1e-8 of R'R where the information has 14 right digits.

    Raises
    ------
    DegenerateGeometry
        The information has a smaller rank: some landmark is not determined at all.

    """
    weight = _typical(np.diag(information))
    try:
        # NumPy's leaves the interpreter to others meanwhile, SciPy's does not.
        factor = np.linalg.cholesky(information + weight * null_basis @ null_basis.T).T
    except np.linalg.LinAlgError:
        raise DegenerateGeometry(UNDETERMINED) from None
    vector = scipy.linalg.solve_triangular(factor, gradient, trans='T', check_finite=False)
    return _without_gauge(factor, vector, null_basis)


def factor_root(root: Floats, vector: Floats, null_basis: Floats) -> tuple[Floats, Floats]:
    """
    Upper trapezoid R (n - g, n) and c with |root x + vector|² = |R x + c|² + const.

    `root` (k, n) may have any number of rows; `null_basis` as in `factor_information`, which
    this replaces where squaring the root would lose too many digits.
    """
    weight = np.sqrt(_typical(np.sum(root**2, axis=0)))
    stacked = np.vstack([root, weight * null_basis.T])
    factor, rotated = triangulate(stacked, np.append(vector, np.zeros(null_basis.shape[1])))
    if len(factor) < root.shape[1] or not np.abs(np.diag(factor)).all():
        raise DegenerateGeometry(UNDETERMINED)
    return _without_gauge(factor, rotated, null_basis)


def _typical(diagonal: Floats) -> float:
    return float(np.mean(diagonal)) if len(diagonal) else 1.0


ROWS_PER_BLOCK = 64
"""Rows that are rotated at once: many enough for BLAS, few beside those of a sub-map."""


def _without_gauge(factor: Floats, vector: Floats, null_basis: Floats) -> tuple[Floats, Floats]:
    """
    Take the null space, which has been made definite, out of a triangular factor (n, n).

    Its image under the factor is rotated into g rows, which are dropped. They go from the last
    block of rows up to the first: so the rows that stay begin where those of R do, and n³ of work
    becomes n².
    """
    columns, gauge = len(factor), null_basis.shape[1]
    rows, image = np.column_stack([factor, vector]), factor @ null_basis
    trapezoid = np.zeros((columns - gauge, columns + 1))
    carried, carried_image, end = rows[:0], image[:0], columns - gauge
    for start in reversed(range(0, columns, ROWS_PER_BLOCK)):
        own = slice(start, start + ROWS_PER_BLOCK)
        rotation, root = np.linalg.qr(np.vstack([carried_image, image[own]]), mode='complete')
        turned = rotation.T @ np.vstack([carried, rows[own]])[:, start:]
        if len(turned) > gauge:
            trapezoid[start:end, start:] = upper_qr(turned[gauge:])
            end = start
        carried = np.pad(turned[:gauge], [(0, 0), (start, 0)])
        carried_image = root[:gauge]
    return trapezoid[:, :-1], trapezoid[:, -1]
