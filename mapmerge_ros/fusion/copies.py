# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One sub-map under two names: it would count its data twice."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import scipy.sparse

from mapmerge_ros.arrays import Floats
from mapmerge_ros.association import Correspondences, Decision, PairMatch
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.refusal import Refusal
from mapmerge_ros.geometry import Gauge, align, scene_radius
from mapmerge_ros.submap import SubMap

MAX_RELATIVE_GAP = 1e-5
"""
Median distance of a copy's landmarks from the original's, over the extent of the map.

Two bundles of one place differ by 1e-4 and more, also where they share the images; a copy in
another frame and scale by rounding, 1e-7 in the worst case of float32.
"""
MIN_COMMON_SHARE = 0.8
"""Of the smaller map's landmarks or candidates: a copy has all of them in common."""

MAX_RELATIVE_COST, LEAST_RMS_PX = 1e-5, 1e-3
"""
Difference of what the observations of a copy cost, and residual from which that says something.

c is float32; maps without noise cost nothing wherever they come from.
"""

MIN_COMMON = 8
"""Landmarks from which positions that agree mean something: fewer are as good as fitted."""


def without_copies(
    submaps: Sequence[SubMap], found: Correspondences
) -> tuple[tuple[SubMap, ...], tuple[Refusal, ...]]:
    """Sub-maps that are no copy of one before them in order of map_id, and the copies."""
    pairs = [pair for pair, match in found.matches.items() if _matched(submaps, pair, match)]
    pairs += [pair for pair in _in_one_space(submaps, found) if _is_same(submaps, pair)]
    refused: dict[int, Refusal] = {}
    for pair in sorted(pairs):
        if pair[0] in refused or pair[1] in refused:
            continue
        original, copy = sorted(pair, key=lambda k: submaps[k].map_id)
        reason = (
            f'its data would count twice: its {len(submaps[copy].landmark_ids)} landmarks '
            f'are those of {submaps[original].map_id}'
        )
        refused[copy] = Refusal(submaps[copy].map_id, reason)
    kept = tuple(submap for k, submap in enumerate(submaps) if k not in refused)
    return kept, tuple(refused.values())


def _matched(submaps: Sequence[SubMap], pair: tuple[int, int], match: PairMatch) -> bool:
    """Whether two sub-maps that were joined by descriptors are one."""
    if match.decision is not Decision.JOINED or match.S_a_b is None:
        return False
    if len(match.rows_a) < MIN_COMMON_SHARE * match.evidence.candidates:
        return False
    a, b = (submaps[k] for k in pair)
    return _coincide(a.points[match.rows_a], match.S_a_b.apply(b.points[match.rows_b]))


def _in_one_space(submaps: Sequence[SubMap], found: Correspondences) -> Iterator[tuple[int, int]]:
    """Pairs of one id space that have nearly all landmarks of one in common."""
    sizes = [len(tracks) for tracks in found.tracks]
    rows = np.repeat(np.arange(len(sizes)), sizes)
    columns = np.concatenate([np.zeros(0, np.int64), *found.tracks])
    linked = columns >= 0
    owned = scipy.sparse.csr_array(
        (np.ones(int(linked.sum()), np.int64), (rows[linked], columns[linked])),
        shape=(len(sizes), found.count),
    )
    common = scipy.sparse.triu(owned @ owned.T, 1).tocoo()
    for a, b, count in zip(common.row, common.col, common.data, strict=True):
        space = submaps[int(a)].id_space
        is_one = space and space == submaps[int(b)].id_space
        if is_one and count >= max(MIN_COMMON, MIN_COMMON_SHARE * min(sizes[a], sizes[b])):
            yield int(a), int(b)


def _is_same(submaps: Sequence[SubMap], pair: tuple[int, int]) -> bool:
    """
    Whether two sub-maps of one id space come from one bundle, up to its frame and scale.

    Where landmarks lie is not enough: bundles linearised at the same points would do. What the
    observations cost there depends neither on the frame nor on which landmarks are compressed.
    """
    a, b = (submaps[k] for k in pair)
    if (a.residual_count, a.dof) != (b.residual_count, b.dof):
        return False
    costs_px2 = [each.a**2 + float(each.c @ each.c) for each in (a, b)]
    if min(costs_px2) < a.redundancy * LEAST_RMS_PX**2:
        return False
    if abs(costs_px2[0] - costs_px2[1]) > MAX_RELATIVE_COST * costs_px2[0]:
        return False
    _, rows_a, rows_b = np.intersect1d(a.landmark_ids, b.landmark_ids, return_indices=True)
    points_a, points_b = a.points[rows_a], b.points[rows_b]
    try:
        found = align(points_a, points_b, gauge=Gauge.SIMILARITY)
    except DegenerateGeometry:
        return False
    return _coincide(points_a, found.S_target_source.apply(points_b))


def _coincide(points: Floats, others: Floats) -> bool:
    gap = np.median(np.linalg.norm(points - others, axis=1))
    return bool(gap <= MAX_RELATIVE_GAP * scene_radius(points))
