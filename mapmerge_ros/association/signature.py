# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Short codes of descriptors, and keys under which near ones meet (locality-sensitive hashing).

A function of one map alone: computed once, whatever other maps there are. The projections are
fixed, not learnt, so that no order of arrival and no other map changes them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from mapmerge_ros.arrays import Bytes, Floats, Ints
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.submap import Descriptors, DescriptorType

SIFT_CODE_BITS = 256


@dataclass(frozen=True, slots=True, eq=False)
class Signature:
    """What screening knows of one map."""

    kind: tuple[DescriptorType, int]
    """Descriptors of another type or size are never compared."""
    codes: npt.NDArray[np.uint16]
    """(k, words): Hamming distances between them follow those of the descriptors"""
    keys: npt.NDArray[np.uint32]
    """(k, tables)"""

    def __len__(self) -> int:
        return len(self.codes)


def signature(descriptors: Descriptors, config: AssociationConfig) -> Signature:
    """Codes and keys of the landmarks that have a descriptor."""
    rows = descriptors.rows[descriptors.known]
    codes = _sift_codes(rows) if descriptors.type is DescriptorType.SIFT else rows
    if codes.shape[1] % 2:
        codes = np.pad(codes, ((0, 0), (0, 1)))
    kind = descriptors.type, descriptors.size
    bits = SIFT_CODE_BITS if descriptors.type is DescriptorType.SIFT else 8 * descriptors.size
    keys = _keys(codes, bits, config)
    return Signature(kind, np.ascontiguousarray(codes).view(np.uint16), keys)


def distances(a: npt.NDArray[np.uint16], b: npt.NDArray[np.uint16]) -> Floats:
    """(n,) share of the bits that differ, row by row."""
    different = _popcount()[a ^ b].sum(axis=1, dtype=np.int64)
    share: Floats = different / (16.0 * a.shape[1])
    return share


def _sift_codes(rows: Bytes) -> Bytes:
    """(k, 32) signs of projections without mean: angles between the descriptors' variations."""
    return np.packbits(rows.astype(np.float32) @ _projections() > 0.0, axis=1)


@cache
def _projections() -> Floats:
    directions = np.random.default_rng(0).normal(size=(128, SIFT_CODE_BITS))
    projections: Floats = (directions - directions.mean(axis=0)).astype(np.float32)
    return projections


def _keys(codes: Bytes, bits: int, config: AssociationConfig) -> npt.NDArray[np.uint32]:
    """Key (k, tables) of every row: some of its bits, others for every table."""
    unpacked = np.unpackbits(codes, axis=1)
    chosen = _chosen_bits(bits, config.hash_tables, config.hash_bits)
    powers = (1 << np.arange(chosen.shape[1])).astype(np.uint32)
    keys: npt.NDArray[np.uint32] = np.stack(
        [unpacked[:, own].astype(np.uint32) @ powers for own in chosen], axis=1
    )
    return keys


@cache
def _chosen_bits(bits: int, tables: int, size: int) -> Ints:
    rng = np.random.default_rng(0)
    chosen: Ints = np.array([rng.permutation(bits)[:size] for _ in range(tables)])
    return chosen


@cache
def _popcount() -> Bytes:
    every = np.arange(1 << 16, dtype=np.uint16).view(np.uint8).reshape(-1, 2)
    counts: Bytes = np.unpackbits(every, axis=1).sum(axis=1, dtype=np.uint8)
    return counts
