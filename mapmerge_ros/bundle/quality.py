# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Which tracks of a bundle can be trusted: by their residuals, compared with their neighbours.

On real images whole tracks sit on the wrong key point, and a merge of them is refused however
right it is. Choosing by residuals does not spoil the statistics of the rest: where the noise is
Gaussian, residuals of an adjusted bundle say nothing about the errors of its points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.bundle.bundle import Bundle
from mapmerge_ros.bundle.elimination import sum_by_point
from mapmerge_ros.bundle.linearise import linearise


@dataclass(frozen=True, slots=True)
class TrackQuality:
    """What makes a track good enough to be compressed."""

    good_ratio: float = 2 / 3
    """
    Share of a session's tracks that are good, by residual variance.

    Brings the variance factor of Brighton from 2.6 to 1.1, Boruszyn from 2.9 to 1.3; four fifths
    leave 1.2 and 1.7, one half loses landmarks for 0.9 and 1.0.
    """
    neighbours: int = 12
    """Candidates that make an area, the track itself among them."""
    best_of_area: int = 4
    """
    Tracks of an area that are good whatever the rest of the session is like.

    A third: poor texture keeps enough landmarks to show a moved object. On the sets at hand it
    adds 1 to 4 % of landmarks and nothing to the variance factor.
    """
    prior_redundancy: float = 3.0
    """
    Weight of the session's typical variance in that of a track, as redundant coordinates.

    Two views leave one, whose square is small by luck half of the time.
    """


def track_variances(bundle: Bundle, prior_redundancy: float = 3.0) -> Floats:
    """
    Residual variance (n,) [px²] of each track, over its own redundancy.

    Three coordinates of a track are taken up by its point. The session's median is mixed in with
    the weight of `prior_redundancy` coordinates.
    """
    lin = linearise(bundle)
    squares = sum_by_point(lin, np.sum(lin.residuals_px**2, axis=1))
    redundancy = 2.0 * np.bincount(bundle.observation_points) - 3.0
    typical = np.median(squares / redundancy)
    variances: Floats = (prior_redundancy * typical + squares) / (prior_redundancy + redundancy)
    return variances


def good_tracks(bundle: Bundle, rows: Ints, quality: TrackQuality) -> Mask:
    """
    Which of the candidates `rows` (k,) are good tracks, (k,).

    Good are those in the better part of the session, and the best of every area, so that no
    part of the map is left without landmarks.
    """
    variances = track_variances(bundle, quality.prior_redundancy)
    good: Mask = variances[rows] <= np.quantile(variances, quality.good_ratio)
    if not len(rows):
        return good
    count = min(quality.neighbours, len(rows))
    points = bundle.points[rows]
    _, near = cKDTree(points).query(points, np.arange(1, count + 1))
    better = (variances[rows][near] < variances[rows][:, None]).sum(axis=1)
    good |= better < quality.best_of_area
    return good
