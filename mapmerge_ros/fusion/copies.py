# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One sub-map under two names: it would count its data twice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapmerge_ros.association import Correspondences, Decision, PairMatch
from mapmerge_ros.fusion.refusal import Refusal
from mapmerge_ros.geometry import scene_radius
from mapmerge_ros.submap import SubMap

MAX_RELATIVE_GAP = 1e-5
"""
Median distance of a copy's landmarks from the original's, over the extent of the map.

Two bundles of one place differ by 1e-4 and more, also where they share the images; a copy in
another frame and scale by rounding, 1e-7 in the worst case of float32.
"""
MIN_COMMON_SHARE = 0.8
"""Of the smaller map's candidates: a copy has all its landmarks in common."""


def without_copies(
    submaps: Sequence[SubMap], found: Correspondences
) -> tuple[tuple[SubMap, ...], tuple[Refusal, ...]]:
    """Sub-maps that are no copy of one before them in order of map_id, and the copies."""
    refused: dict[int, Refusal] = {}
    for (a, b), match in sorted(found.matches.items()):
        if a in refused or b in refused or not _is_copy(submaps[a], submaps[b], match):
            continue
        original, copy = sorted((a, b), key=lambda k: submaps[k].map_id)
        name = submaps[copy].map_id
        reason = (
            f'its data would count twice: its {len(submaps[copy].landmark_ids)} landmarks '
            f'are those of {submaps[original].map_id}'
        )
        refused[copy] = Refusal(name, reason)
    kept = tuple(submap for k, submap in enumerate(submaps) if k not in refused)
    return kept, tuple(refused.values())


def _is_copy(a: SubMap, b: SubMap, match: PairMatch) -> bool:
    if match.decision is not Decision.JOINED or match.S_a_b is None:
        return False
    if len(match.rows_a) < MIN_COMMON_SHARE * match.evidence.candidates:
        return False
    points_a, points_b = a.points[match.rows_a], b.points[match.rows_b]
    gap = np.median(np.linalg.norm(points_a - match.S_a_b.apply(points_b), axis=1))
    return bool(gap <= MAX_RELATIVE_GAP * scene_radius(points_a))
