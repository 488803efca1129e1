# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors that are believed of honest sub-maps: what needs larger ones is refused."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.fusion.contrasts import Contrasts

MAX_PHI, MAX_TAU_UNITS, MAX_OMEGA_RADII = 2.5, 1.0, 5e-3
"""
What is believed of an honest map: three times what EuRoC and Caliterra show, no more.

φ is 0.9 there; ω is 1.6e-3 of the scene radius. τ may be as large as a typical difference.
A merge that needs more is refused, whatever would explain it.
"""


def largest_variances(data: Contrasts) -> Floats:
    """Variances (3,) that are believed of honest maps at most."""
    radii = MAX_OMEGA_RADII * data.radius / data.unit
    return np.array([MAX_PHI, MAX_TAU_UNITS**2, radii**2])
