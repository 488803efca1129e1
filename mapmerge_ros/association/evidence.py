# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What speaks for an alignment beside the number of its inliers."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.association.alignment import Aligned, Matched, align_candidates
from mapmerge_ros.association.config import AssociationConfig
from mapmerge_ros.association.pair import Evidence
from mapmerge_ros.geometry import Gauge


def gather(
    matched: Matched,
    ratios: Floats,
    aligned: Aligned | None,
    gauge: Gauge,
    config: AssociationConfig,
) -> Evidence:
    """Evidence about an alignment of the candidates; `ratios` (n,) say how distinctive each is."""
    if aligned is None:
        return Evidence(len(matched), 0, np.inf, 0.0, 0.0, 0.0)
    inliers = int(aligned.inliers.sum())
    return Evidence(
        candidates=len(matched),
        inliers=inliers,
        log_nfa=aligned.log_nfa,
        inlier_ratio=inliers / len(matched),
        agreeing_ratio=_agreeing_ratio(matched, ratios, aligned, config),
        second_ratio=_second_support(matched, aligned, gauge, config) / inliers,
        clear_ratio=float(np.quantile(ratios[aligned.inliers], config.clear_share)),
    )


def _agreeing_ratio(
    matched: Matched, ratios: Floats, aligned: Aligned, config: AssociationConfig
) -> float:
    """Share of the strong candidates with both ends in the overlap that agree."""
    inliers = aligned.inliers
    strong = ratios <= np.median(ratios[inliers])
    overlap = _within(matched.points_a, inliers, config.overlap_radius)
    overlap &= _within(matched.points_b, inliers, config.overlap_radius)
    judged = strong & overlap
    agree = aligned.distances <= config.agreeing_tolerances * aligned.tolerance
    return float((agree & judged).sum() / max(judged.sum(), 1))


def _within(points: Floats, inliers: Mask, radius: float) -> Mask:
    """Which points are not farther off than `radius` standard deviations of the inliers."""
    centred = points - points[inliers].mean(axis=0)
    cov = np.atleast_2d(np.cov(centred[inliers].T, bias=True))
    # Flat scenes: the thickness of the inliers is no measure of the overlap's.
    cov = cov + 0.01 * np.trace(cov) * np.eye(3)
    squared = np.einsum('ni,ij,nj->n', centred, np.linalg.inv(cov), centred)
    near: Mask = squared <= radius**2
    return near


def _second_support(
    matched: Matched, aligned: Aligned, gauge: Gauge, config: AssociationConfig
) -> int:
    """Inliers of the best alignment of what the first one leaves over."""
    rest = aligned.distances > config.left_over_tolerances * aligned.tolerance
    second = align_candidates(matched[rest], gauge, config)
    return int(second.inliers.sum()) if second is not None else 0
