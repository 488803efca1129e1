# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether the truth lies within what a merge says it does not know."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.stats

from mapmerge_ros.arrays import Floats
from mapmerge_ros.fusion.associate import associate_by_id
from mapmerge_ros.fusion.element import Element
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


def cost_p(submaps: Sequence[SubMap], truth: Floats, a_tilde: float, sigma: float) -> float:
    """
    p-value of the truth under the cost of merging: its rise from the optimum ã to the truth.

    `truth` (n, 3) in the order of the sorted ids; every landmark is shared. This region may be
    bent, the one above is an ellipsoid.
    """
    association = associate_by_id(submaps)
    shared = association.views > 1
    elements = [
        Element.from_submap(submap, tracks, shared[tracks], 1.0)
        for submap, tracks in zip(submaps, association.tracks, strict=True)
    ]
    residuals = [element.residuals(element.place(truth)) for element in elements]
    rise = float(sum(own @ own for own in residuals)) - a_tilde
    freedom = truth.size - int(min(submap.gauge for submap in submaps))
    return float(scipy.stats.chi2.sf(np.maximum(rise, 0.0) / sigma**2, freedom))
