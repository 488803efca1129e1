# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks of equal id that cannot be the same point: single ones, and most of a pair's."""

from __future__ import annotations

from enum import Enum

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.pair_frames import align_pairs, extents, usual
from mapmerge_ros.geometry import Gauge, Segments

MIN_TO_JUDGE = 8
"""Common landmarks below which the median distance says nothing about a single one."""

MANY = 0.1
"""
Share of a pair's landmarks that contradict it from which others are believed to more easily.

Ids that are dealt out anew fall near each other, or on landmarks that are known badly, too.
"""

AMONG_MANY = 1.0 / 3.0
"""
Share of the usual significance that is enough then, however near they are.

Up to 4 % of true landmarks of real pairs are as far off (Ladybug), in most sets 1 %: a loss where
a tenth is wrong, but one that costs less than a wrong one that stays.
"""

UNLIKE = 0.5
"""
Median distance of a pair's landmarks, over their extent, from which equal ids say nothing.

Landmarks whose ids are shuffled come to 0.8 to 1.2: all of one map is put into the middle of the
other. True pairs stay below 0.13 (EuRoC), and below 1.0 px: it must be significant, too.
"""

UNLIKE_QUARTER = 0.1
"""
The same of their lower quartile: not even a quarter agrees.

Shuffled ids come to 0.55 and more, pairs with more wrong ids than right ones to 0.13 where their
frame is missed, and to 0.01 where it is found.
"""

MIRROR = np.array([1.0, 1.0, -1.0])

MUCH_NEARER = 0.1
"""Share of its residuals that a pair has with one of the two mirrored, if that is the trouble."""


class Unlike(Enum):
    """What is wrong with a pair of sub-maps as a whole, in words."""

    NUMBERED_ANEW = (
        'landmarks have ids in common, but are not the same points: one of the two numbers them '
        'anew, and needs an id_space of its own'
    )
    MIRRORED = (
        'landmarks in common are mirror images: the axes of one of the two are left-handed, and '
        'one of them has to be turned round'
    )


def rows_apart(
    points_a: Floats, points_b: Floats, precision: Floats, segments: Segments, config: FusionConfig
) -> Mask:
    """
    Rows whose landmarks, in one frame, cannot be the same point as most of their pair are.

    `precision` (rows,) [px² / unit²] is that of the distance between points (rows, 3).
    """
    owners = segments.owners
    distances = np.linalg.norm(points_a - points_b, axis=1)
    standardised = distances * np.sqrt(precision)
    significance = standardised / config.contradiction_ratio
    least = usual(standardised, segments)[owners]
    far = distances > config.contradiction_extent * extents(points_a, segments)[owners]
    apart = (significance > least) & far
    many = segments.counts(apart) > MANY * segments.lengths
    apart |= (significance > AMONG_MANY * least) & many[owners]
    return np.asarray(apart & (segments.lengths >= MIN_TO_JUDGE)[owners])


def why_unlike(
    points_a: Floats,
    points_b: Floats,
    moved_b: Floats,
    precision: Floats,
    segments: Segments,
    gauges: Ints,
    config: FusionConfig,
) -> dict[int, Unlike]:
    """
    Pairs whose landmarks cannot be the same points, and what they are instead.

    `moved_b` (rows, 3) are those of b in the frame of a, as near as the `gauges` (n,) allow.
    """
    residuals_px = _residuals_px(points_a, moved_b, precision, segments)
    judged = (segments.lengths >= MIN_TO_JUDGE) & (residuals_px > config.contradiction_ratio)
    found = dict[int, Unlike]()
    for k in np.flatnonzero(judged).tolist():
        rows = segments.rows(k)
        one = Segments.of_lengths([rows.stop - rows.start])
        pair = points_a[rows], points_b[rows], precision[rows], one
        # Frames that may not move say nothing about ids, nor about axes.
        nearest = moved_b[rows] if gauges[k] == Gauge.SIMILARITY else _in_any_frame(*pair)
        if nearest is None:
            continue
        (residual_px,) = _residuals_px(pair[0], nearest, *pair[2:])
        if residual_px <= config.contradiction_ratio:
            continue
        mirrored = _in_any_frame(pair[0], pair[1] * MIRROR, *pair[2:])
        if mirrored is not None and (
            _residuals_px(pair[0], mirrored, *pair[2:])[0] < MUCH_NEARER * residual_px
        ):
            found[k] = Unlike.MIRRORED
        elif _are_far(pair[0], nearest, one):
            found[k] = Unlike.NUMBERED_ANEW
    return found


def _are_far(points_a: Floats, points_b: Floats, one: Segments) -> bool:
    """Whether most landmarks of a pair, in one frame, are far from each other."""
    distances = np.linalg.norm(points_a - points_b, axis=1)
    (size,) = extents(points_a, one)
    far = np.median(distances) > UNLIKE * size
    return bool(far or one.lower_quartiles(distances)[0] > UNLIKE_QUARTER * size)


def _in_any_frame(
    points_a: Floats, points_b: Floats, precision: Floats, one: Segments
) -> Floats | None:
    """Landmarks (rows, 3) of b in the frame of a, of any scale; None if that is not determined."""
    found = align_pairs(points_a, points_b, one, np.array([int(Gauge.SIMILARITY)]), precision)
    return found.S_target_source.apply(one, points_b) if found.determined.all() else None


def _residuals_px(
    points_a: Floats, points_b: Floats, precision: Floats, segments: Segments
) -> Floats:
    """Median residual (n,) of a landmark of each pair."""
    return segments.medians(np.linalg.norm(points_a - points_b, axis=1) * np.sqrt(precision))
