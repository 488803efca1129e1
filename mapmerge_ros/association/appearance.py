# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How alike two landmarks look, and what that says about their being one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Bytes, Floats, Ints
from mapmerge_ros.submap import Descriptors, DescriptorType

BLOCK = 4096
"""Pairs of descriptors that are compared at once: they stay in the cache."""
BITS = np.array([number.bit_count() for number in range(256)], np.uint8)
"""Bits that are set in each byte."""
LARGEST_LOG_RATIO = 12.0
"""Of what a descriptor alone may say: the tails of a distribution learnt from few links lie."""


def comparable(a: Descriptors, b: Descriptors) -> bool:
    """Whether a distance between the two is defined."""
    return a.type is b.type and a.size == b.size and a.type is not DescriptorType.NONE


def distances(a: Descriptors, b: Descriptors, of_a: Ints, of_b: Ints) -> Floats:
    """Distance (n,) of pairs of descriptors: bits that differ, or Euclidean; nan without one."""
    if not comparable(a, b):
        return np.full(len(of_a), np.nan)
    measure = _hamming if a.type is DescriptorType.BINARY else _euclidean
    found = np.empty(len(of_a))
    for start in range(0, len(found), BLOCK):
        block = slice(start, start + BLOCK)
        found[block] = measure(a.rows[of_a[block]], b.rows[of_b[block]])
    found[~(a.known[of_a] & b.known[of_b])] = np.nan
    return found


def _hamming(a: Bytes, b: Bytes) -> Floats:
    return np.asarray(_bits(a ^ b).sum(axis=1), np.float64)


def _bits(numbers: Bytes) -> Bytes:
    """Bits that are set in each number, 0 to 255."""
    if hasattr(np, 'bitwise_count'):  # NumPy 2
        return np.asarray(np.bitwise_count(numbers))
    return BITS[numbers]


def _euclidean(a: Bytes, b: Bytes) -> Floats:
    gaps = a.astype(np.float32) - b  # integers below 2^24 in all sums: exact
    return np.asarray(np.sqrt(np.einsum('nd,nd->n', gaps, gaps), dtype=np.float64))


@dataclass(frozen=True, slots=True)
class Appearance:
    """Distances of descriptors of one landmark and of neighbours, as normal distributions."""

    right_mean: float
    right_std: float
    wrong_mean: float
    wrong_std: float

    @classmethod
    def learnt(cls, right: Floats, wrong: Floats) -> Appearance:
        """From distances of links and of neighbours, nearly all of which are wrong; nan: none."""
        right, wrong = right[~np.isnan(right)], wrong[~np.isnan(wrong)]
        if len(right) < 3 or len(wrong) < 3:
            return cls(0.0, 1.0, 0.0, 1.0)
        least = 0.02 * float(np.mean(wrong)) + 1e-9
        return cls(
            float(np.mean(right)),
            max(float(np.std(right)), least),
            float(np.mean(wrong)),
            max(float(np.std(wrong)), least),
        )

    def log_ratio(self, distance: Floats) -> Floats:
        """Log likelihood ratio (n,) of being one landmark; falls with distance, 0 for nan."""
        inside = np.clip(distance, *self._monotone())
        value = (
            0.5 * ((inside - self.wrong_mean) / self.wrong_std) ** 2
            - 0.5 * ((inside - self.right_mean) / self.right_std) ** 2
            + np.log(self.wrong_std / self.right_std)
        )
        return np.asarray(
            np.nan_to_num(np.clip(value, -LARGEST_LOG_RATIO, LARGEST_LOG_RATIO), nan=0.0)
        )

    def _monotone(self) -> tuple[float, float]:
        """Distances between which the ratio of the two normal densities falls."""
        right, wrong = self.right_std**-2, self.wrong_std**-2
        if np.isclose(right, wrong):
            return -np.inf, np.inf
        turn = (right * self.right_mean - wrong * self.wrong_mean) / (right - wrong)
        return (turn, np.inf) if right > wrong else (-np.inf, turn)
