# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a merge can be believed: its price against what noise alone would cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.outcome import Verdict
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.submap import SubMap


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """
    Noise of the sub-maps of one merge.

    Unknown σ are one and the same, estimated from all of those sub-maps together: so every
    observation weighs as in the full bundle, and the F test is exact.
    """

    sigma: float
    """Of a residual of unit weight, px"""
    weights: Floats
    """Per sub-map (sigma / σ_k)²"""
    estimated_from: int
    """Redundancy behind an estimated σ; 0 = every σ is known"""


def pool_noise(submaps: Sequence[SubMap]) -> Noise:
    """One σ for all sub-maps that do not know theirs, and the weights that follow."""
    unknown = [submap for submap in submaps if submap.sigma == 0.0]
    redundancy = sum(submap.redundancy for submap in unknown)
    estimate = sum(submap.a**2 for submap in unknown) / max(redundancy, 1)
    variances = np.array([submap.sigma**2 or estimate for submap in submaps])
    # Noise-free input (a = 0 everywhere) has no scale of its own: any equal weights will do.
    variances = np.maximum(variances, np.finfo(float).tiny ** 0.5)
    redundancies = np.array([max(submap.redundancy, 1) for submap in submaps], float)
    reference = float(redundancies @ variances / redundancies.sum())
    return Noise(float(np.sqrt(reference)), reference / variances, redundancy)


def degrees_of_freedom(views: Ints, gauges: Sequence[Gauge], gauge: Gauge) -> int:
    """Σ 3 κ_i (i - 1) - (Σ g_k - g): eq. 13 for sub-maps of any gauge."""
    locked = 3 * int(np.sum(np.maximum(views - 1, 0)))
    return locked - (sum(int(own) for own in gauges) - int(gauge))


def verify(a_tilde: float, dof: int, noise: Noise, config: FusionConfig) -> Verdict:
    """
    Test the price of merging: Γ(dof/2, 1/2σ²) for known σ, F for an estimated one.

    With nothing merged (dof = 0) there is nothing to doubt.
    """
    if dof <= 0:
        return Verdict(a_tilde, 0, noise.sigma, float('nan'), 1.0, accepted=True, reason='')
    factor = a_tilde / (dof * noise.sigma**2)
    if noise.estimated_from:
        p_value = float(scipy.stats.f.sf(factor, dof, noise.estimated_from))
    else:
        p_value = float(scipy.stats.chi2.sf(factor * dof, dof))
    accepted = p_value >= config.significance
    reason = (
        ''
        if accepted
        else (
            f'the merge costs {factor:.3g} times what noise of {noise.sigma:.3g} px explains '
            f'(p {_rounded(p_value)}, below {config.significance:g})'
        )
    )
    return Verdict(a_tilde, dof, noise.sigma, factor, p_value, accepted, reason)


def _rounded(p_value: float) -> str:
    return f'= {p_value:.2g}' if p_value >= 1e-300 else '< 1e-300'
