# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The most significant alignment of candidates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.contrario import Background, Significance, significance
from mapmerge_ros.association.samples import sampled_models
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.geometry import Gauge, Similarity, align, scene_radius


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """Candidates as geometry: row i of a and of b may be the same point."""

    points_a: Floats
    """(n, 3)"""
    points_b: Floats
    """(n, 3)"""
    variances_a: Floats
    """(n,) mean of the three coordinates' variances, cameras fixed; zeros = unknown"""
    variances_b: Floats
    """(n,)"""

    def __len__(self) -> int:
        return len(self.points_a)

    def __getitem__(self, rows: Ints | Mask) -> Matched:
        return Matched(
            self.points_a[rows],
            self.points_b[rows],
            self.variances_a[rows],
            self.variances_b[rows],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """An alignment and its evidence."""

    S_a_b: Similarity
    log_nfa: float
    tolerance: float
    """Distance of the farthest inlier, frame of a"""
    distances: Floats
    """(n,) of all candidates, frame of a"""

    @property
    def inliers(self) -> Mask:
        """Whether each is within the tolerance (n,)."""
        return self.distances <= self.tolerance


def align_candidates(matched: Matched, gauge: Gauge, config: AssociationConfig) -> Aligned | None:
    """Most significant alignment of the candidates, best first; None when there is none."""
    if len(matched) < config.min_candidates:
        return None
    limit = config.max_tolerance_ratio * scene_radius(matched.points_a)
    sparse = matched[_spread_rows(len(matched), config.max_scored)]
    models = sampled_models(sparse.points_a, sparse.points_b, gauge, config)
    if not len(models) or limit == 0.0:
        return None
    near = _coarse_background(matched.points_a, config)
    distances = models.distances(sparse.points_a, sparse.points_b)
    scores = significance(distances, near, gauge.minimal_points, limit)
    order = np.argsort(scores.log_nfa, kind='stable')[: config.refined_models]
    best: Aligned | None = None
    for tried, row in enumerate(order):
        if not np.isfinite(scores.log_nfa[row]) or _settled(best, tried, config):
            break
        found = _refine(models.one(int(row)), matched, gauge, limit, config)
        if found is not None and (best is None or found.log_nfa < best.log_nfa):
            best = found
    return best


def _settled(best: Aligned | None, tried: int, config: AssociationConfig) -> bool:
    """Whether no other alignment can be right: most candidates agree with this one."""
    if best is None or tried < config.refined_if_settled:
        return False
    return bool(best.inliers.mean() > 0.5) and best.log_nfa <= config.max_log_nfa


def _refine(
    S_a_b: Similarity, matched: Matched, gauge: Gauge, limit: float, config: AssociationConfig
) -> Aligned | None:
    """Fit to the inliers, judge anew against wrong pairings, until nothing improves."""
    best = _judge(S_a_b, matched, gauge, limit, config)
    for _ in range(config.refinements):
        inliers = best.inliers
        if inliers.sum() < max(gauge.minimal_points, 1):
            break
        try:
            S_a_b = _fit(best, matched, inliers, gauge)
        except DegenerateGeometry:
            break
        found = _judge(S_a_b, matched, gauge, limit, config)
        if found.log_nfa > best.log_nfa:
            break
        best = found
        if np.array_equal(found.inliers, inliers):
            break
    return best if np.isfinite(best.log_nfa) else None


def _fit(aligned: Aligned, matched: Matched, inliers: Mask, gauge: Gauge) -> Similarity:
    """
    Weighted alignment of the inliers.

    What the landmarks' own covariances do not explain (maps bend) is added to all of them alike.
    """
    own = matched.variances_a[inliers]
    own = own + aligned.S_a_b.scale**2 * matched.variances_b[inliers]
    squared = aligned.distances[inliers] ** 2 / 3.0
    drift = max(float(np.median(squared)), np.finfo(float).tiny)
    weights = 1.0 / (own + drift)
    return align(
        matched.points_a[inliers], matched.points_b[inliers], gauge=gauge, weights=weights
    ).S_target_source


def _judge(
    S_a_b: Similarity, matched: Matched, gauge: Gauge, limit: float, config: AssociationConfig
) -> Aligned:
    moved = S_a_b.apply(matched.points_b)
    distances = np.linalg.norm(moved - matched.points_a, axis=1)
    wrong = _wrong_pairings(matched.points_a, moved, config)
    score: Significance = significance(distances[None], wrong, gauge.minimal_points, limit)
    return Aligned(S_a_b, float(score.log_nfa[0]), float(score.tolerances[0]), distances)


def _wrong_pairings(points_a: Floats, moved: Floats, config: AssociationConfig) -> Background:
    """Distances of candidates' landmarks in a to other candidates' landmarks in b."""
    rows = _spread_rows(len(points_a), config.max_background)
    apart = points_a[rows][:, None] - moved[rows]
    distances = np.sqrt(np.einsum('ijk,ijk->ij', apart, apart))
    return Background(np.sort(distances[~np.eye(len(rows), dtype=bool)]))


def _coarse_background(points_a: Floats, config: AssociationConfig) -> Background:
    """Nearly the same for every right alignment, at the price of one."""
    return _wrong_pairings(points_a, points_a, config)


def _spread_rows(count: int, most: int) -> Ints:
    """At most `most` rows, spread evenly over the ranking."""
    rows: Ints = np.arange(count)
    return rows if count <= most else (np.arange(most) * count) // most
