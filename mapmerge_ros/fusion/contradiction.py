# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Why a sub-map is in quarantine: whom it contradicts, by how much, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.outgoing import Merged
from mapmerge_ros.fusion.quarantine import Trial
from mapmerge_ros.fusion.refusal import Quarantine, Refusal, listed
from mapmerge_ros.fusion.wrong_ids import MIRROR
from mapmerge_ros.geometry import Gauge, align_robustly, scene_radius
from mapmerge_ros.submap import SubMap

MOST_NAMED = 3
"""Sub-maps that are named: those that it shares most with."""

MUCH_NEARER = 0.3
"""Share of its distance from which a mirrored sub-map is said to fit; one that is, has 0.12."""


def refusals(trial: Trial, submaps: Sequence[SubMap], association: Association) -> list[Refusal]:
    """Refuse the culprits of a group, each for its own reason."""
    return [_refusal(k, trial, submaps, association) for k in trial.without]


def _refusal(k: int, trial: Trial, submaps: Sequence[SubMap], association: Association) -> Refusal:
    group, merged = trial.parts[0]
    shared = {j: len(_common(association, k, j)) for j in group}
    most = [j for j in sorted(group, key=lambda j: -shared[j]) if shared[j]][:MOST_NAMED]
    points_global, points_map = _where_others_have_them(k, trial, submaps, association)
    gauge = max(submaps[k].gauge, merged.component.gauge)
    distance = _apart(points_global, points_map, gauge)
    ratio = distance / scene_radius(merged.component.landmarks.points_global)
    evidence = Quarantine(
        tuple(submaps[j].map_id for j in most), trial.price_ratio, trial.p_value, distance, ratio
    )
    reason = _in_words(evidence, trial, merged)
    as_it_is, mirrored = (
        _apart(points_global, points, Gauge.SIMILARITY)
        for points in (points_map, points_map * MIRROR)
    )
    if mirrored < MUCH_NEARER * as_it_is:
        reason += '. Its mirror image would fit: are its axes left-handed?'
    return Refusal(submaps[k].map_id, reason, evidence)


def _common(association: Association, k: int, j: int) -> np.ndarray:
    return np.intersect1d(association.tracks[k], association.tracks[j])


def _where_others_have_them(
    k: int, trial: Trial, submaps: Sequence[SubMap], association: Association
) -> tuple[Floats, Floats]:
    """Landmarks (n, 3) that a sub-map has in common with the merged ones, global and its own."""
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
    order = np.argsort(association.tracks[k])
    rows = order[np.searchsorted(association.tracks[k], every, sorter=order)]
    return points_global, submaps[k].compressed_points[rows]


def _apart(points_global: Floats, points_map: Floats, gauge: Gauge) -> float:
    """Median distance [global map units] of landmarks (n, 3) in one frame."""
    try:
        S_global_map = align_robustly(
            points_global, points_map, gauge=gauge, weights=np.ones(len(points_map))
        ).S_target_source
    except DegenerateGeometry:
        return float('nan')
    return float(np.median(np.linalg.norm(points_global - S_global_map.apply(points_map), axis=1)))


def _in_words(evidence: Quarantine, trial: Trial, merged: Merged) -> str:
    whose = 'it' if len(trial.without) == 1 else f'{len(trial.without)} such sub-maps'
    p_value = f'{evidence.p_value:.1e}' if evidence.p_value > 1e-300 else 'below 1e-300'
    price = (
        f'{whose} would add {evidence.price_ratio:.3g} times what their noise explains '
        f'(p {p_value})'
    )
    # What convinced the search: a price that is small, or there by chance, did not.
    suspected = trial.suspicion and not trial.costs_too_much
    return (
        f'quarantined: it contradicts {listed(evidence.contradicts)}; half of its landmarks are '
        f'more than {evidence.distance:.3g} off ({evidence.distance_ratio:.2%} of the scene). The '
        f'other {len(merged.component.map_ids)} agree '
        f'(p {merged.component.verdict.p_value:.2g}), and '
        f'{trial.suspicion if suspected else price}'
    )
