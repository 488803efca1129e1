# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How large the noise of each sub-map is: what it claims, what it shows, what the others show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.submap import SubMap

UNLIKE = 2.0
"""
Ratio of two maps' residuals from which they do not have the same noise.

Sessions of one camera differ by up to 1.4 (EuRoC), where the redundancy says 3 %: so σ is one for
all, as a test by redundancy would leave no two together.
"""

TOO_SMALL = 0.2
"""Residuals over a claimed sigma below which the claim is told; who says 1 px often has 0.4 px."""

LEAST_REDUNDANCY = 30
"""Below it an estimate of σ is off by a factor by chance."""

EXACT_PX = 1e-6
"""Residuals below which there is no noise, and its size is that of rounding."""


@dataclass(frozen=True, slots=True)
class Noise:
    """
    Noise of the sub-maps of one merge.

    Unknown σ that are alike are one, estimated from all of those sub-maps together: so every
    observation weighs as in the full bundle, and the F test is exact.
    """

    sigma: float
    """Of a residual of unit weight, px"""
    weights: Floats
    """Per sub-map (sigma / σ_k)²"""
    estimated_from: int
    """Redundancy behind an estimated σ; 0 = every σ is known"""


def pool_noise(submaps: Sequence[SubMap]) -> Noise:
    """
    One σ for all sub-maps that do not know theirs, and the weights that follow.

    One whose residuals are unlike those of the others has a σ of its own: it would make theirs
    large, and whatever is wrong with them would be noise.
    """
    known = np.array([submap.sigma**2 for submap in submaps])
    shown, redundancies, unlike = _compared(submaps)
    pooled = (known == 0.0) & ~unlike
    estimate = redundancies[pooled] @ shown[pooled] / max(redundancies[pooled].sum(), 1.0)
    variances = np.where(known > 0.0, known, np.where(unlike, shown, estimate))
    # Noise-free input (a = 0 everywhere) has no scale of its own: any equal weights will do.
    variances = np.maximum(variances, np.finfo(float).tiny ** 0.5)
    reference = _middle(variances, np.maximum(redundancies, 1.0))
    estimated_from = int(redundancies[known == 0.0].sum())
    return Noise(float(np.sqrt(reference)), reference / variances, estimated_from)


def noise_notes(submaps: Sequence[SubMap]) -> dict[str, str]:
    """By map_id, what is odd about the noise of a sub-map."""
    shown, redundancies, unlike = _compared(submaps)
    like = [k for k, submap in enumerate(submaps) if submap.sigma == 0.0 and not unlike[k]]
    usual = np.sqrt(np.median(shown[like])) if like else np.nan
    notes = {}
    for k, submap in enumerate(submaps):
        found = float(np.sqrt(shown[k]))
        if unlike[k]:
            less = 'less' if found > usual else 'more'
            notes[submap.map_id] = (
                f'its residuals are {found:.2g} px, those of the others {usual:.2g} px: '
                f'it counts for {less}'
            )
        elif submap.sigma and redundancies[k] >= LEAST_REDUNDANCY:
            ratio = found / submap.sigma
            if not TOO_SMALL <= ratio <= UNLIKE:
                notes[submap.map_id] = (
                    f'its residuals are {found:.2g} px, and it claims a sigma of '
                    f'{submap.sigma:.2g} px: it counts for too {"much" if ratio > 1 else "little"}'
                )
    return notes


def _compared(submaps: Sequence[SubMap]) -> tuple[Floats, Floats, Mask]:
    """Variance of the residuals of each, its redundancy, and whether it is unlike the others'."""
    redundancies = np.array([submap.redundancy for submap in submaps], np.float64)
    shown = np.array([submap.a**2 for submap in submaps]) / np.maximum(redundancies, 1.0)
    unknown = np.array([submap.sigma == 0.0 for submap in submaps])
    unlike = np.zeros(len(submaps), bool)
    if unknown.any():
        usual = _middle(shown[unknown], redundancies[unknown])
        ratio = shown / max(usual, EXACT_PX**2)
        unlike = unknown & (redundancies >= LEAST_REDUNDANCY) & (usual > EXACT_PX**2)
        unlike &= (ratio > UNLIKE**2) | (ratio < UNLIKE**-2)
    return shown, redundancies, unlike


def _middle(values: Floats, weights: Floats) -> float:
    """Median of values, each as often as its weight says."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(total, 0.5 * total[-1])]])
