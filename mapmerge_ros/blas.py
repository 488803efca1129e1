# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Products and factors of large matrices in place, while other threads go on.

`scipy.linalg.blas` holds the interpreter while it computes, so that whoever receives messages
would wait for a fusion; and it silently works on a copy where a matrix is a part of another one.
These call the same routines at the addresses that SciPy exports for Cython (`__pyx_capi__`).

All matrices are float64, and their columns are contiguous: Fortran order, or a block of such a
matrix. Only lower triangles are read and written.
"""

from __future__ import annotations

import ctypes
from types import ModuleType
from typing import Any

import numpy as np
from scipy.linalg import cython_blas, cython_lapack

from mapmerge_ros.arrays import Floats

_ITEM = np.dtype(np.float64).itemsize

_STRIP = 64
"""Columns that are mirrored at once."""


class _Arguments(ctypes.Structure):
    """Numbers of one call, side by side: Fortran wants their addresses."""

    _fields_ = (
        ('alpha', ctypes.c_double),
        ('beta', ctypes.c_double),
        ('rows', ctypes.c_int),
        ('columns', ctypes.c_int),
        ('leading_a', ctypes.c_int),
        ('leading_c', ctypes.c_int),
        ('info', ctypes.c_int),
    )


_BETA, _ROWS, _COLUMNS, _LEADING_A, _LEADING_C, _INFO = (
    getattr(_Arguments, name).offset
    for name in ('beta', 'rows', 'columns', 'leading_a', 'leading_c', 'info')
)

_LETTERS = ctypes.create_string_buffer(b'LRNT')
_LOWER, _RIGHT, _PLAIN, _TRANSPOSED = (ctypes.addressof(_LETTERS) + k for k in range(4))
_LEFT = _LOWER


def _routine(module: ModuleType, name: str, arguments: int) -> Any:
    """Routine that takes addresses, and gives the interpreter away while it runs."""
    capsule = module.__pyx_capi__[name]
    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype, api.PyCapsule_GetName.argtypes = (
        ctypes.c_char_p,
        [ctypes.py_object],
    )
    api.PyCapsule_GetPointer.restype, api.PyCapsule_GetPointer.argtypes = (
        ctypes.c_void_p,
        [ctypes.py_object, ctypes.c_char_p],
    )
    signature = api.PyCapsule_GetName(capsule)
    # Whole numbers of another size would be read as something else, without a word.
    kinds = signature.decode().removeprefix('void (').removesuffix(')').split(', ')
    strange = [x for x in kinds if x not in ('char *', 'int *') and not x.endswith('_d *')]
    if len(kinds) != arguments or strange:
        raise ImportError(f'{module.__name__} exports {name} as {signature!r}: use another SciPy')
    kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)
    return kind(api.PyCapsule_GetPointer(capsule, signature))


_dsyrk = _routine(cython_blas, 'dsyrk', 10)
_dtrmm = _routine(cython_blas, 'dtrmm', 11)
_dlauum = _routine(cython_lapack, 'dlauum', 5)
_dpotrf = _routine(cython_lapack, 'dpotrf', 5)
_dpotri = _routine(cython_lapack, 'dpotri', 5)


def add_square(c: Floats, a: Floats, alpha: float = 1.0, beta: float = 1.0) -> None:
    """Make c (n, n) beta c + alpha a a', a (n, k); with beta = 0, c may hold anything."""
    (n, k), size = a.shape, _square(c)
    if size != n:
        raise ValueError(f'the square of {n} rows does not go into {size} x {size}')
    if not n:
        return
    values = _Arguments(alpha, beta, n, k, _leading(a), _leading(c))
    at = ctypes.addressof(values)
    _dsyrk(
        _LOWER,
        _PLAIN,
        at + _ROWS,
        at + _COLUMNS,
        at,
        _address(a),
        at + _LEADING_A,
        at + _BETA,
        _address(c),
        at + _LEADING_C,
    )


def times_lower(
    b: Floats, lower: Floats, alpha: float = 1.0, *, transposed: bool = False, right: bool = False
) -> None:
    """Make b alpha L b, or alpha b L with L to the `right`; L' for L where `transposed`."""
    size, (m, n) = _square(lower), b.shape
    if size != (n if right else m):
        raise ValueError(f'a triangle of {size} cannot multiply {m} x {n}')
    if not b.size:
        return
    values = _Arguments(alpha, 0.0, m, n, _leading(lower), _leading(b))
    at = ctypes.addressof(values)
    _dtrmm(
        _RIGHT if right else _LEFT,
        _LOWER,
        _TRANSPOSED if transposed else _PLAIN,
        _PLAIN,
        at + _ROWS,
        at + _COLUMNS,
        at,
        _address(lower),
        at + _LEADING_A,
        _address(b),
        at + _LEADING_C,
    )


def square_of_lower(lower: Floats) -> None:
    """L (n, n) becomes L'L."""
    _in_place(_dlauum, lower)


def cholesky(matrix: Floats) -> None:
    """
    Symmetric matrix (n, n) becomes its Cholesky factor L.

    Raises
    ------
    numpy.linalg.LinAlgError
        It is not positive definite.

    """
    # OpenBLAS goes on where a pivot is not a number.
    if _in_place(_dpotrf, matrix) or not np.isfinite(matrix.diagonal()).all():
        raise np.linalg.LinAlgError('a matrix is not positive definite')


def inverse_of_factored(lower: Floats) -> Floats:
    """
    Inverse (n, n), both triangles, of the matrix whose Cholesky factor L is; in its place.

    Raises
    ------
    numpy.linalg.LinAlgError
        L has a zero on its diagonal.

    """
    if _in_place(_dpotri, lower):
        raise np.linalg.LinAlgError('a matrix is singular')
    mirror(lower)
    return lower


def mirror(matrix: Floats) -> None:
    """Fill the upper triangle (n, n) with the lower one, by strips that the cache holds."""
    above = np.tri(_STRIP, k=-1, dtype=np.bool_).T
    for first in range(0, _square(matrix), _STRIP):
        strip = slice(first, first + _STRIP)
        rest = slice(first + _STRIP, None)
        matrix[strip, rest] = matrix[rest, strip].T
        corner = matrix[strip, strip]
        np.copyto(corner, corner.T, where=above[: len(corner), : len(corner)])


def inverse_of_positive(matrix: Floats) -> Floats:
    """
    Inverse (n, n) of a symmetric positive definite matrix; half the work of solving for it.

    Raises
    ------
    numpy.linalg.LinAlgError
        It is not positive definite.

    """
    lower = np.array(matrix, np.float64, order='F')
    cholesky(lower)
    return inverse_of_factored(lower)


def _in_place(routine: Any, matrix: Floats) -> int:
    size = _square(matrix)
    if not size:
        return 0
    values = _Arguments(rows=size, leading_a=_leading(matrix))
    at = ctypes.addressof(values)
    routine(_LOWER, at + _ROWS, _address(matrix), at + _LEADING_A, at + _INFO)
    return int(values.info)


def _square(matrix: Floats) -> int:
    rows, columns = (int(size) for size in matrix.shape)
    if rows != columns:
        raise ValueError(f'{rows} x {columns} is not square')
    return rows


def _leading(matrix: Floats) -> int:
    """Numbers from one column to the next."""
    step, stride = matrix.strides
    rows, columns = matrix.shape
    if matrix.dtype != np.float64 or (step != _ITEM and rows > 1):
        raise ValueError('a matrix of float64 with contiguous columns is needed')
    if columns > 1 and (stride % _ITEM or stride < rows * _ITEM):
        raise ValueError('columns that do not overlap are needed')
    return max(stride // _ITEM if columns > 1 else rows, 1)


def _address(matrix: Floats) -> int:
    address: int = matrix.__array_interface__['data'][0]
    return address
