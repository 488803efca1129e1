# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Why a sub-map is in quarantine: whom it contradicts, by how much, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.outgoing import Merged
from mapmerge_ros.fusion.quarantine import Trial
from mapmerge_ros.fusion.refusal import Quarantine, Refusal
from mapmerge_ros.geometry import align_robustly, scene_radius
from mapmerge_ros.submap import SubMap

MOST_NAMED = 3
"""Sub-maps that are named: those that it shares most with."""


def refusals(trial: Trial, submaps: Sequence[SubMap], association: Association) -> list[Refusal]:
    """Refuse the culprits of a group, each for its own reason."""
    return [_refusal(k, trial, submaps, association) for k in trial.without]


def _refusal(k: int, trial: Trial, submaps: Sequence[SubMap], association: Association) -> Refusal:
    group, merged = trial.parts[0]
    shared = {j: len(_common(association, k, j)) for j in group}
    most = [j for j in sorted(group, key=lambda j: -shared[j]) if shared[j]][:MOST_NAMED]
    distance, ratio = _distances(k, trial, submaps, association)
    evidence = Quarantine(
        tuple(submaps[j].map_id for j in most), trial.price_ratio, trial.p_value, distance, ratio
    )
    return Refusal(submaps[k].map_id, _in_words(evidence, trial, merged), evidence)


def _common(association: Association, k: int, j: int) -> np.ndarray:
    return np.intersect1d(association.tracks[k], association.tracks[j])


def _distances(
    k: int, trial: Trial, submaps: Sequence[SubMap], association: Association
) -> tuple[float, float]:
    """Median distance from where the others have the landmarks, and that over the scene."""
    group, merged = trial.parts[0]
    points, tracks = [], []
    for slot, j in enumerate(group):
        _, rows, _ = np.intersect1d(
            association.tracks[j], association.tracks[k], return_indices=True
        )
        points.append(merged.S_global_maps[slot].apply(submaps[j].compressed_points[rows]))
        tracks.append(association.tracks[j][rows])
    every, owners = np.unique(np.concatenate(tracks), return_inverse=True)
    points_global = np.zeros((len(every), 3))
    np.add.at(points_global, owners, np.concatenate(points))
    points_global /= np.bincount(owners)[:, None]
    rows = np.searchsorted(association.tracks[k], every, sorter=np.argsort(association.tracks[k]))
    points_map = submaps[k].compressed_points[np.argsort(association.tracks[k])[rows]]
    gauge = max(submaps[k].gauge, merged.component.gauge)
    try:
        S_global_map = align_robustly(
            points_global, points_map, gauge=gauge, weights=np.ones(len(every))
        ).S_target_source
    except DegenerateGeometry:
        return float('nan'), float('nan')
    distances = np.linalg.norm(points_global - S_global_map.apply(points_map), axis=1)
    median = float(np.median(distances))
    return median, median / scene_radius(merged.component.landmarks.points_global)


def _in_words(evidence: Quarantine, trial: Trial, merged: Merged) -> str:
    names = ' and '.join(
        filter(None, [', '.join(evidence.contradicts[:-1]), *evidence.contradicts[-1:]])
    )
    whose = 'it' if len(trial.without) == 1 else f'{len(trial.without)} such sub-maps'
    p_value = f'{evidence.p_value:.1e}' if evidence.p_value > 1e-300 else 'below 1e-300'
    return (
        f'quarantined: it contradicts {names}; half of its landmarks are more than '
        f'{evidence.distance:.3g} off ({evidence.distance_ratio:.2%} of the scene). The other '
        f'{len(merged.component.map_ids)} agree (p {merged.component.verdict.p_value:.2g}), and '
        f'{whose} would add {evidence.price_ratio:.3g} times what their noise explains '
        f'(p {p_value})'
    )
