# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmark descriptors: one row of bytes each, and how to compare them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from mapmerge_ros.arrays import Bytes, Ints, Mask, frozen
from mapmerge_ros.errors import InvalidValue


class DescriptorType(IntEnum):
    """Which distance compares two descriptors."""

    NONE = 0
    BINARY = 1
    """Hamming (ORB, BRISK, FREAK)."""
    SIFT = 2
    """Euclidean, 128 bytes."""


@dataclass(frozen=True, slots=True, eq=False)
class Descriptors:
    """Descriptors (n, size) of n landmarks."""

    type: DescriptorType
    rows: Bytes

    def __post_init__(self) -> None:
        object.__setattr__(self, 'rows', frozen('descriptors', self.rows, np.uint8, (None, None)))
        if self.type is DescriptorType.NONE and self.size:
            raise InvalidValue('descriptor_type: NONE, but descriptors are there')
        if self.type is DescriptorType.SIFT and self.size != 128:
            raise InvalidValue(f'descriptor_size: SIFT has 128 bytes, got {self.size}')
        if self.type is DescriptorType.BINARY and not self.size:
            raise InvalidValue('descriptor_size: binary descriptors of 0 bytes')

    @classmethod
    def none(cls, count: int) -> Descriptors:
        """Return the descriptors of `count` landmarks that have none."""
        return cls(DescriptorType.NONE, np.zeros((count, 0), np.uint8))

    @property
    def size(self) -> int:
        """Bytes of one descriptor."""
        return int(self.rows.shape[1])

    @property
    def known(self) -> Mask:
        """(n,) which landmarks have a descriptor: all zeros mean none."""
        return np.asarray(self.rows.any(axis=1))

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, rows: Ints | Mask | slice) -> Descriptors:
        return Descriptors(self.type, self.rows[rows])
