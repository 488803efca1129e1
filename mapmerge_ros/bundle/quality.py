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
from mapmerge_ros.bundle.linearise import Linearisation, linearise


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
    adds up to 4 % of landmarks and nothing to the variance factor.
    """
    prior_redundancy: float = 3.0
    """
    Weight of the session's typical variance in that of a track, as redundant coordinates.

    Two views leave one, whose square is small by luck half of the time.
    """
    gaussian_tail_ratio: float = 1.25
    """
    Tail ratio up to which a session has no bad tracks, only noise.

    Real sessions have 1.5 to 2.8, simulated ones 1.00 with a standard deviation of 0.03; without
    this rule more than half of their links went, and 10 % of the accuracy.
    """


@dataclass(frozen=True, slots=True, eq=False)
class TrackResiduals:
    """How well every track of a session fits its points."""

    squares: Floats
    """(n,) sum of squared residuals [px²]"""
    redundancy: Floats
    """(n,) residuals less the three coordinates that the point takes up"""

    @classmethod
    def of(cls, lin: Linearisation) -> TrackResiduals:
        """Residuals of all tracks at the point of linearisation."""
        squares = sum_by_point(lin, np.sum(lin.residuals_px**2, axis=1))
        return cls(squares, 2.0 * np.bincount(lin.bundle.observation_points) - 3.0)

    @property
    def tail_ratio(self) -> float:
        """Mean over typical residual variance of the tracks: 1 for Gaussian noise, else larger."""
        # Wilson and Hilferty: the median of chi-square over its degrees of freedom.
        medians = self.redundancy * (1.0 - 2.0 / (9.0 * self.redundancy)) ** 3
        typical = float(np.median(self.squares / medians))
        mean = float(np.sum(self.squares) / np.sum(self.redundancy))
        return mean / typical if typical > 0.0 else 1.0

    def variances(self, prior_redundancy: float) -> Floats:
        """
        Residual variance (n,) [px²] of each track.

        The session's median is mixed in with the weight of `prior_redundancy` residuals.
        """
        typical = np.median(self.squares / self.redundancy)
        total = prior_redundancy * typical + self.squares
        return np.asarray(total / (prior_redundancy + self.redundancy))


def claimed_variances(lin: Linearisation, pooled_px2: float) -> Floats:
    """
    Noise (n,) [px²] that each point of a session is said to be seen with.

    `pooled_px2`, the session's, where noise is Gaussian. Where whole tracks sit on the wrong key
    point, each track's own: a bad one must not be taken for as sure as its neighbours.
    """
    quality, residuals = TrackQuality(), TrackResiduals.of(lin)
    if residuals.tail_ratio <= quality.gaussian_tail_ratio:
        return np.full(len(residuals.squares), pooled_px2)
    prior = quality.prior_redundancy
    own = (prior * pooled_px2 + residuals.squares) / (prior + residuals.redundancy)
    return np.minimum(own, pooled_px2)


def good_tracks(bundle: Bundle, rows: Ints, quality: TrackQuality) -> Mask:
    """
    Which of the candidates `rows` (k,) are good tracks, (k,).

    Good are those in the better part of the session, and the best of every area, so that no
    part of the map is left without landmarks. All are, where the session has no heavy tails.
    """
    residuals = TrackResiduals.of(linearise(bundle))
    if residuals.tail_ratio <= quality.gaussian_tail_ratio:
        return np.ones(len(rows), np.bool_)
    variances = residuals.variances(quality.prior_redundancy)
    good: Mask = variances[rows] <= np.quantile(variances, quality.good_ratio)
    if not len(rows):
        return good
    count = min(quality.neighbours, len(rows))
    points = bundle.points[rows]
    _, near = cKDTree(points).query(points, np.arange(1, count + 1))
    better = (variances[rows][near] < variances[rows][:, None]).sum(axis=1)
    good |= better < quality.best_of_area
    return good
