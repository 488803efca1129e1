# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Array types and the checks that immutable values apply once, at their border."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from mapmerge_ros.errors import InvalidValue

Floats = npt.NDArray[np.floating[Any]]
Ints = npt.NDArray[np.int64]
Ids = npt.NDArray[np.uint64]
Bytes = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]


def frozen(
    name: str,
    values: Any,
    dtype: npt.DTypeLike,
    shape: tuple[int | None, ...],
) -> npt.NDArray[Any]:
    """
    Return a read-only copy of `values`, checked; what nobody can write to is not copied.

    Parameters
    ----------
    name
        Field name for the error message.
    shape
        Expected shape, None for a free length.

    Raises
    ------
    InvalidValue
        Wrong shape, or a value that is not finite.

    """
    array = values if _lasts(values, dtype) else np.array(values, dtype=dtype, order='C')
    if array.shape == (0,):  # an empty list has no columns of its own
        array = array.reshape((0, *(n or 0 for n in shape[1:])))
    matches = array.ndim == len(shape) and all(
        want is None or want == got for want, got in zip(shape, array.shape, strict=True)
    )
    if not matches:
        wanted = ' x '.join('n' if n is None else str(n) for n in shape)
        got = ' x '.join(map(str, array.shape)) or 'a scalar'
        raise InvalidValue(f'{name}: expected {wanted} values, got {got}')
    if array.dtype.kind == 'f' and not np.isfinite(array).all():
        bad = int(np.flatnonzero(~np.isfinite(array).ravel())[0])
        raise InvalidValue(f'{name}: value {bad} is not finite')
    array.flags.writeable = False
    return array


def _lasts(values: Any, dtype: npt.DTypeLike) -> bool:
    """Whether this is an array of the type that views `bytes`, as those of a message do."""
    if not isinstance(values, np.ndarray) or values.dtype != dtype:
        return False
    base: Any = values.base
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, memoryview):
        base = base.obj
    return isinstance(base, bytes) and values.flags.aligned and values.flags.c_contiguous
