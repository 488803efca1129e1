# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors that are believed of honest sub-maps: what needs larger ones is refused."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.distributions import chi2_tail
from mapmerge_ros.fusion.contrasts import Contrasts

MAX_PHI, MAX_TAU_UNITS, MAX_OMEGA_RADII = 2.5, 1.0, 5e-3
"""
What is believed of an honest map: three times what EuRoC and Caliterra show, no more.

φ is 0.9 there; ω is 1.6e-3 of the scene radius. τ may be as large as a typical difference.
A merge that needs more is refused, whatever would explain it.
"""

HONEST_PHI, LOG_PHI_STD = 0.7, 0.35
HONEST_OMEGA_RADII, LOG_OMEGA_STD = 1.6e-3, 0.4
HONEST_ASIDE, ASIDE_STD = 0.10, 0.025
"""
Errors of EuRoC and Caliterra, with 30 to 300 landmarks of all tracks, and how much they vary.

Of the share that is aside it is what chance does not explain. Their sums of squares are up to 5.3,
those of Ladybug, Brighton and Boruszyn, for checking, 9.9. 16.9 refuses at the usual level where
the price of the rest is a median one (p = 0.5), 18.3 where that price is as low as can be (p = 1).
"""


def largest_variances(data: Contrasts) -> Floats:
    """Variances (3,) that are believed of honest maps at most."""
    radii = MAX_OMEGA_RADII * data.radius / data.unit
    return np.array([MAX_PHI, MAX_TAU_UNITS**2, radii**2])


def p_plausible(phi: float, omega_radii: float, aside: float, count: float) -> float:
    """
    Probability of errors as large as these, all of them together, of maps of real cameras.

    `aside` of `count` landmarks are too far off. Smaller errors than usual do not make up for
    larger ones.
    """
    share = aside / max(count, 1)
    chance = HONEST_ASIDE * (1.0 - HONEST_ASIDE) / max(count, 1)
    excesses = (
        np.log(max(phi, HONEST_PHI) / HONEST_PHI) / LOG_PHI_STD,
        np.log(max(omega_radii, HONEST_OMEGA_RADII) / HONEST_OMEGA_RADII) / LOG_OMEGA_STD,
        max(share - HONEST_ASIDE, 0.0) / np.sqrt(chance + ASIDE_STD**2),
    )
    return float(chi2_tail(float(np.square(excesses).sum()), len(excesses)))
