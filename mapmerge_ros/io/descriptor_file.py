# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Descriptors beside a COLMAP model."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from mapmerge_ros.arrays import Ids
from mapmerge_ros.io.colmap_files import ModelError
from mapmerge_ros.submap import Descriptors, DescriptorType

_TYPES = {
    128: DescriptorType.SIFT,
    32: DescriptorType.BINARY,
    48: DescriptorType.BINARY,
    64: DescriptorType.BINARY,
}


def load_descriptors(path: Path, point_ids: Ids) -> Descriptors:
    """
    Descriptors of the given points, from an .npz with `point_id` [n] and `descriptors` [n, size].

    Without the file nobody has one. A point without a row in it gets zeros: there is one type
    and one size for all points of a map.

    Raises
    ------
    ModelError
        The file is damaged, an array is missing or has another type or shape.

    """
    if not path.exists():
        return Descriptors.none(len(point_ids))
    ids, rows = _load(path)
    if ids.ndim != 1 or ids.dtype.kind not in 'iu':
        raise ModelError(f'{path}: point_id: expected int64 [n], got {_kind(ids)}')
    if rows.dtype != np.uint8 or rows.ndim != 2 or rows.shape[1] not in _TYPES:
        raise ModelError(
            f'{path}: descriptors: expected uint8 [n, 128, 64, 48 or 32], got {_kind(rows)}'
        )
    if len(ids) != len(rows):
        raise ModelError(f'{path}: descriptors: {len(rows)} rows, point_id: {len(ids)}')
    if len(np.unique(ids)) != len(ids):
        raise ModelError(f'{path}: point_id: an id appears twice')
    order = np.argsort(ids)
    found, slots = _slots(ids[order].astype(np.uint64), point_ids)
    if not found.any():
        raise ModelError(f'{path}: point_id: none of the points of the model')
    picked = np.zeros((len(point_ids), rows.shape[1]), np.uint8)
    picked[found] = rows[order[slots[found]]]
    return Descriptors(_TYPES[rows.shape[1]], picked)


def _load(path: Path) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return arrays['point_id'], arrays['descriptors']
    except KeyError as err:
        raise ModelError(f'{path}: point_id or descriptors is missing') from err
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, AttributeError, TypeError) as err:
        raise ModelError(f'{path}: not an .npz file, or damaged: write it with np.savez') from err


def _slots(known: Ids, wanted: Ids) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.intp]]:
    """Whether each wanted id is among the known, sorted ones, and where."""
    if not len(known):
        return np.zeros(len(wanted), bool), np.zeros(len(wanted), np.intp)
    slots = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
    return known[slots] == wanted, slots


def _kind(array: npt.NDArray[Any]) -> str:
    return f'{array.dtype} {list(array.shape)}'
