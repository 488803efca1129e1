# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Merging as before the paper: transforms first, by Procrustes, then landmarks, linearly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapmerge_ros.arrays import Ids
from mapmerge_ros.bundle import Bundle, FramePrior, MapName, compress
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.geometry import Gauge, align
from mapmerge_ros.submap import SubMap

HELD = 1e-4
"""
Standard deviation [rad, map units, ratio] by which the cameras of a map hold its frame.

Small against what is estimated (1e-3 and more). On the bookshelf, mean prices of unchanged pairs
are 1.15 at 1e-3, 1.36 at 1e-4 and 1.37 at 1e-5 times what noise explains: close to the limit.
"""


def compress_held(bundle: Bundle, name: MapName, landmark_ids: Ids) -> SubMap:
    """
    Compress a bundle whose frame is that of its cameras: R is square and of full rank.

    A linear merge needs a gauge that is held: where every R is blind to the size of its map,
    q = 0 costs nothing (R_k q°_k = 0). Here the cameras hold it, as in most bundle adjusters.
    """
    prior = FramePrior(HELD, HELD, HELD, HELD)
    sigma_px = bundle.sigma_px or 1.0
    held = replace(
        bundle, gauge=Gauge.NONE, prior=prior, sigma_px=sigma_px, prior_residuals_px=np.zeros(7)
    )
    return compress(held, name, landmark_ids, catalogue=False)


def merge_with_fixed_transform(a: SubMap, b: SubMap) -> float:
    """
    Price ã of merging two maps of the same landmarks [px²], the transform fixed beforehand.

    min over q of |R_a (q - q°_a) + c_a|² + |R_b (T q - q°_b) + c_b|²: linear, solved once.

    Raises
    ------
    DegenerateGeometry
        The maps are not about the same landmarks in the same order, or those lie on a line.

    """
    if not np.array_equal(a.compressed_ids, b.compressed_ids):
        raise DegenerateGeometry('the linear merge needs the same landmarks in both maps')
    S_a_b = align(a.compressed_points, b.compressed_points).S_target_source
    moved = b.transformed(S_a_b)
    matrix = np.vstack([a.triangle(), moved.triangle()])
    # Unknown: the step from q°_a; in coordinates, rounding would drown small prices.
    offset = (moved.compressed_points - a.compressed_points).ravel()
    vector = np.concatenate([a.c, moved.c - moved.triangle() @ offset])
    step = np.linalg.lstsq(matrix, -vector, rcond=None)[0]
    residuals = matrix @ step + vector
    return float(residuals @ residuals)
