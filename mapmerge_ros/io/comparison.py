# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How far a merged map is from the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion import Fusion, Landmarks
from mapmerge_ros.geometry import Gauge, Similarity, align_robustly, scene_radius
from mapmerge_ros.io.true_values import RecordingTruth


@dataclass(frozen=True, slots=True, eq=False)
class TruthComparison:
    """Distances [m] of shared landmarks from where they are, after the best similarity."""

    count: int
    median_error: float
    rmse: float
    radius: float
    """Median distance of these landmarks from their middle [m]: the size of the scene."""
    S_world_global: Similarity


def compare_with_truth(fusion: Fusion, truth: RecordingTruth) -> TruthComparison:
    """
    Compare the landmarks that two or more sub-maps have; those that were moved are left out.

    A minority of wrong landmarks does not turn the alignment.

    Raises
    ------
    DegenerateGeometry
        Fewer than three such landmarks, or all on a line.

    """
    if not fusion.components:
        raise DegenerateGeometry('nothing was merged: there is no map to compare with the truth')
    merged = _merged_points(fusion.components[0].landmarks, truth)
    moved = {int(own) for move in truth.moved for own in move.landmark_ids}
    world = {
        int(own): point
        for own, point in zip(truth.landmark_ids, truth.points_world, strict=True)
        if int(own) not in moved
    }
    pairs = [(point, world[own]) for own, point in merged if own in world]
    if len(pairs) < Gauge.SIMILARITY.minimal_points:
        raise DegenerateGeometry(f'only {len(pairs)} merged landmarks are in the truth')
    points_global, points_world = map(np.array, zip(*pairs, strict=True))
    weights = np.ones(len(pairs))
    S_world_global = align_robustly(
        points_world, points_global, gauge=Gauge.SIMILARITY, weights=weights
    ).S_target_source
    errors = np.linalg.norm(S_world_global.apply(points_global) - points_world, axis=1)
    return TruthComparison(
        count=len(pairs),
        median_error=float(np.median(errors)),
        rmse=float(np.sqrt(np.mean(errors**2))),
        radius=scene_radius(points_world),
        S_world_global=S_world_global,
    )


def _merged_points(landmarks: Landmarks, truth: RecordingTruth) -> list[tuple[int, Floats]]:
    """True id and merged position of every landmark that several sub-maps have."""
    names = {
        true_map.map_id: dict(
            zip(true_map.own_ids.tolist(), true_map.true_ids.tolist(), strict=True)
        )
        for true_map in truth.maps
    }
    found = []
    for point, members in zip(landmarks.points_global, landmarks.members(), strict=True):
        if len(members) >= 2:
            map_id, own_id = members[0]
            # A merged map inside the recording is not a robot's: it keeps the ids it has.
            found.append((names.get(map_id, {}).get(own_id, own_id), point))
    return found
