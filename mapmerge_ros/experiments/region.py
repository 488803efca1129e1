# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether the truth lies within the ellipsoid of R̄ and c̄ that a merged map carries."""

from __future__ import annotations

import scipy.stats

from mapmerge_ros.arrays import Floats
from mapmerge_ros.geometry import align
from mapmerge_ros.submap import SubMap, alignment_weights


def reported_p(merged: SubMap, truth: Floats, sigma: float) -> float:
    """
    p-value of the truth (n, 3) under the merged map's own R̄ and c̄: χ²(3n - gauge).

    The truth is taken into the frame of the map as the engine does it, by the hard gauge.
    """
    r, points = merged.triangle(), merged.compressed_points
    S_map_truth = align(
        points, truth, gauge=merged.gauge, weights=alignment_weights(r), scale='tangent'
    ).S_target_source
    residuals = r @ (S_map_truth.apply(truth) - points).ravel() + merged.c
    return float(scipy.stats.chi2.sf(residuals @ residuals / sigma**2, len(r)))
