# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of pairs of sub-maps, from landmarks of which some, or most, may be matched wrongly."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.geometry import Alignments, Segments, align_segments

STEPS = 15
"""Times that the landmarks of a pair are weighed anew."""

SETTLED = 0.05
"""
Largest movement of a landmark by which a pair has settled, over their median distance.

Half of the pairs of S3 get there in four steps. The merge starts from these frames and
contradictions are fifteen medians away; neither asks for more.
"""

POOR = 0.03
"""
Median distance of a pair's landmarks, over their extent, from which samples are tried.

A fit that starts from all landmarks may miss the frame that more than half of them agree on: with
the others in it the scale falls, and all look alike.
"""

POOR_PX = 2.0
"""Median residual of a landmark in its own map that there must be, too; 0.3 to 0.7 are usual."""

MUCH_BETTER = 0.5
"""
Share of that distance which a frame from samples must have to be taken.

One that is right where the other was not has a tenth; those of EuRoC, up to 0.09 apart, all keep
theirs.
"""

SAMPLES = 300
"""Samples of three landmarks; where half of them are wrong, 37 samples are right."""

LEAST_SAMPLED = 8
"""Landmarks from which a sample is worth anything: three of few agree by chance."""

MOST_QUARTILES = 3.0
"""
Median of right distances over their lower quartile, at most.

1.4 where they are Gaussian; of true pairs of five real sets 2.1 at most, in 95 % of EuRoC's 3.4.
"""

REFINEMENTS = 5
"""Times that the landmarks that agree with a sample decide anew who does."""


def align_pairs(
    points_a: Floats, points_b: Floats, segments: Segments, gauges: Ints, weights: Floats
) -> Alignments:
    """
    `align_segments_robustly` of b to a (rows, 3), each pair until it has settled.

    `weights` (rows,) are informations [px² / unit²]. None depends on the others. For a pair that
    fits poorly the frame is tried that the best half of its landmarks agree on (least median of
    squares, Rousseeuw 1984).
    """
    found = align_segments(points_a, points_b, segments, gauges, weights)
    found = _settled(points_a, points_b, segments, gauges, weights, found)
    distances = _distances(points_a, points_b, segments, found)
    fit = segments.medians(distances)
    poor = (fit > POOR * extents(points_a, segments)) & (segments.lengths >= LEAST_SAMPLED)
    poor &= segments.medians(distances * np.sqrt(weights)) > POOR_PX
    each, determined = found.S_target_source, found.determined.copy()
    for k in np.flatnonzero(poor):
        rows = segments.rows(int(k))
        here, there = points_a[rows], points_b[rows]
        again = _sampled(here, there, gauges[[k]])
        left = _distances(here, there, Segments.of_lengths([len(here)]), again)
        if again.determined[0] and np.median(left) < MUCH_BETTER * fit[k]:
            each = each.at(np.array([k]), again.S_target_source)
            determined[k] = True
    return Alignments(each, determined)


def extents(points: Floats, segments: Segments) -> Floats:
    """Median distance (n,) of the points of each segment from their middle."""
    middles = np.column_stack([segments.medians(axis) for axis in points.T])
    return segments.medians(np.linalg.norm(points - middles[segments.owners], axis=1))


def usual(distances: Floats, segments: Segments) -> Floats:
    """
    Distance (n,) that is usual among the landmarks of each pair that agree.

    The median, but where about half are matched wrongly: there it is one of theirs.
    """
    agreeing = MOST_QUARTILES * segments.lower_quartiles(distances)
    size: Floats = np.minimum(segments.medians(distances), agreeing)
    return size


def _settled(
    points_a: Floats,
    points_b: Floats,
    segments: Segments,
    gauges: Ints,
    weights: Floats,
    start: Alignments,
) -> Alignments:
    best, determined = start.S_target_source, start.determined.copy()
    moved, pairs = best.apply(segments, points_b), np.arange(len(segments))
    for _ in range(STEPS):
        distances = np.linalg.norm(moved - points_a, axis=1)
        medians = np.maximum(segments.medians(distances), np.finfo(float).tiny)
        with np.errstate(all='ignore'):
            robust = weights / np.maximum(distances, 0.1 * medians[segments.owners])
        found = align_segments(points_a, points_b, segments, gauges, robust)
        determined[pairs] &= found.determined
        best = best.at(pairs, found.S_target_source)
        before, moved = moved, found.S_target_source.apply(segments, points_b)
        steps = np.linalg.norm(moved - before, axis=1)
        moving = np.maximum.reduceat(steps, segments.ends[:-1]) > SETTLED * medians
        if not moving.any():
            break
        if not moving.all():
            rows = moving[segments.owners]
            points_a, points_b, weights, moved = (
                each[rows] for each in (points_a, points_b, weights, moved)
            )
            pairs, gauges, segments = pairs[moving], gauges[moving], segments.only(moving)
    return Alignments(best, determined)


def _distances(
    points_a: Floats, points_b: Floats, segments: Segments, found: Alignments
) -> Floats:
    """How far apart the landmarks (rows,) of each pair are in one frame, that of a."""
    moved = found.S_target_source.apply(segments, points_b)
    return np.asarray(np.linalg.norm(moved - points_a, axis=1))


def _sampled(points_a: Floats, points_b: Floats, gauge: Ints) -> Alignments:
    """Of the frames of many samples of three landmarks the one of least median distance."""
    count = len(points_a)
    rows = np.argsort(np.random.default_rng(0).random((SAMPLES, count)), axis=1)[:, :3].ravel()
    found = align_segments(
        points_a[rows],
        points_b[rows],
        Segments.of_lengths([3] * SAMPLES),
        np.repeat(gauge, SAMPLES),
        np.ones(len(rows)),
    )
    each, own = found.S_target_source, Segments.of_lengths([count])
    moved = points_b @ each.linear().transpose(0, 2, 1) + each.translations[:, None]
    medians = np.median(np.linalg.norm(moved - points_a, axis=2), axis=1)
    medians[~found.determined] = np.inf
    best = int(np.argmin(medians))
    distances = np.linalg.norm(moved[best] - points_a, axis=1)
    for _ in range(REFINEMENTS):
        # The better half at most decides; what is far off would draw the frame back.
        agreeing = distances <= usual(distances, own)
        refined = align_segments(points_a, points_b, own, gauge, agreeing.astype(np.float64))
        distances = _distances(points_a, points_b, own, refined)
    return refined
