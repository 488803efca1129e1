# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What merging is compared with: Procrustes and averaging, and the distance to the truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapmerge_ros.arrays import Floats, Ids
from mapmerge_ros.experiments.result import ExperimentError
from mapmerge_ros.fusion import Fusion
from mapmerge_ros.geometry import align


def procrustes_average(ids: Sequence[Ids], points_maps: Sequence[Floats]) -> tuple[Ids, Floats]:
    """
    Put maps together by their points alone, one after the other in the given order.

    Each map is registered to the mean of those before it, by all the landmarks that they share;
    matching points are averaged. Returns the sorted ids and the points (n, 3) in the frame of
    the first map.

    Raises
    ------
    DegenerateGeometry
        A map shares too little with those before it.

    """
    every = np.unique(np.concatenate(list(ids)))
    total, count = np.zeros((len(every), 3)), np.zeros(len(every), int)
    for own_ids, points_map in zip(ids, points_maps, strict=True):
        rows = np.searchsorted(every, own_ids)
        known = count[rows] > 0
        placed = points_map
        if count.any():
            mean = total[rows[known]] / count[rows[known], None]
            placed = align(mean, points_map[known]).S_target_source.apply(points_map)
        total[rows] += placed
        count[rows] += 1
    return every, total / count[:, None]


def rmse_to(truth: Floats, points: Floats) -> float:
    """Root mean square distance [m] of points (n, 3) to the truth, after Procrustes."""
    return align(truth, points).rms


def merged_points(fusion: Fusion, ids: Ids) -> Floats:
    """
    Points (n, 3) of the published map for the given ids.

    Raises
    ------
    ExperimentError
        It does not have them all: some map was left out.

    """
    if not fusion.components or not np.isin(ids, fusion.components[0].landmarks.ids).all():
        raise ExperimentError('the merge left a map or a landmark out')
    landmarks = fusion.components[0].landmarks
    order = np.argsort(landmarks.ids)
    rows = order[np.searchsorted(landmarks.ids, ids, sorter=order)]
    points: Floats = landmarks.points_global[rows]
    return points
