# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""5.A.3: a loop closed by merging four walls, with and without the matches that close it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mapmerge_ros.arrays import Floats, Ids
from mapmerge_ros.bundle import Bundle
from mapmerge_ros.experiments.baselines import merged_points, procrustes_average, rmse_to
from mapmerge_ros.experiments.loop_summary import draw, summarise
from mapmerge_ros.experiments.region import reported_p
from mapmerge_ros.experiments.result import Experiment, Values
from mapmerge_ros.experiments.room import (
    SIGMA,
    WIDTHS,
    simulate_room,
    true_points,
    without_last_match,
)
from mapmerge_ros.experiments.whole_map import WHOLE_MAP
from mapmerge_ros.fusion import fuse
from mapmerge_ros.fusion.region import p_value_of
from mapmerge_ros.simulation import Fleet, joint_bundle, solve
from mapmerge_ros.submap import SubMap


def run_one(seed: int, run: int) -> Values:
    """Both scenes once; RMSE in metres, of the shared landmarks."""
    return {
        f'{scene}_{name}': value
        for k, (scene, width) in enumerate(WIDTHS.items())
        for name, value in _one_scene(np.random.default_rng([seed, run, k]), width).items()
    }


def _one_scene(rng: np.random.Generator, width: float) -> Mapping[str, object]:
    fleet = simulate_room(rng, width)
    scene, submaps = fleet.truth.scene, fleet.submaps(catalogue=False)
    open_loop = without_last_match(scene, submaps)
    ids = np.unique(np.concatenate([submap.compressed_ids for submap in submaps]))
    open_ids = np.unique(np.concatenate([submap.compressed_ids for submap in open_loop]))
    merged, unclosed = fuse(submaps, WHOLE_MAP), fuse(open_loop, WHOLE_MAP)
    truth, points = true_points(scene, ids), merged_points(merged, ids)
    component = merged.components[0]
    full = solve(joint_bundle(fleet)).bundle
    full_points = full.points[full.rows_of(ids)]
    return {
        'ours': rmse_to(truth, points),
        'open': rmse_to(true_points(scene, open_ids), merged_points(unclosed, open_ids)),
        'procrustes': rmse_to(truth, _registered(fleet, ids)),
        'full': rmse_to(truth, full_points),
        'to_full': rmse_to(full_points, points),
        'accepted': merged.verdict.accepted,
        'starts': component.starts,
        'p_reported': reported_p(
            component.submap, true_points(scene, component.submap.compressed_ids), SIGMA
        ),
        'p_cost': p_value_of(merged, ids, truth),
        'sizes': _sizes(fleet, submaps, 3 * len(ids)),
    }


def _registered(fleet: Fleet, ids: Ids) -> Floats:
    every, points = procrustes_average(
        [bundle.point_ids for bundle in fleet.bundles],
        [bundle.points for bundle in fleet.bundles],
    )
    return points[np.searchsorted(every, ids)]


def _sizes(fleet: Fleet, submaps: Sequence[SubMap], columns: int) -> list[list[int]]:
    """Landmarks, full Jacobian and R of each map; the last row is that of all together."""
    rows = [
        [*_full_size(bundle), submap.rank, 3 * submap.compressed_count]
        for bundle, submap in zip(fleet.bundles, submaps, strict=True)
    ]
    return [*rows, [*_full_size(joint_bundle(fleet)), sum(row[3] for row in rows), columns]]


def _full_size(bundle: Bundle) -> tuple[int, int, int]:
    return len(bundle.point_ids), bundle.residual_count, bundle.dof + int(bundle.gauge)


EXPERIMENT = Experiment(
    name='loop-closure',
    title='Loop closure by merging four walls (5.A.3)',
    runs=1000,
    run_one=run_one,
    summarise=summarise,
    draw=draw,
)
