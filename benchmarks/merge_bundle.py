# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The full bundle over all observations, which the merge is held to."""

from __future__ import annotations

from typing import Any

import numpy as np
from merge_steps import Values, merged, rmse_to_truth, shared, started, timed
from workloads import DRONES, Workload, workload

from mapmerge_ros.bundle import Bundle
from mapmerge_ros.fusion import Warm

BUNDLE_SECONDS = 360.0
"""Time limit of the full bundle: S4 needs most of it, or more."""

ACCURACY_DRAWS = {'S1': 20, 'S2': 8, 'S3': 6}
"""Draws of which the error is pooled: one draw scatters by 1 %, as few bending modes decide it."""


def bundle(load: Workload, repeats: int) -> Values:
    """Ceres on all observations of all drones, from generalised Procrustes of the messages."""
    joint, limit = _joined(load), {'max_seconds': BUNDLE_SECONDS}
    made, _ = timed(1, lambda _: _adjusted(load, {'max_iterations': 0}, joint))
    took, solved = timed(repeats, lambda _: _adjusted(load, limit, joint))
    return {
        **{name: value - made[name] for name, value in took.items()},
        'iterations': solved.iterations,
        'converged': solved.converged,
        'points': len(joint.point_ids),
        'keyframes': len(joint.keyframe_ids),
        'observation_bytes': 12.0 * len(joint.observations_px) / len(load.submaps),
        'rmse_m': _error_of_bundle(load, solved),
    }


def accuracy(load: Workload, repeats: int) -> Values:
    """Error to the truth over that of the full bundle, over many draws of noise and scene."""
    draws, errors = ACCURACY_DRAWS.get(load.name, repeats), []
    for seed in range(draws):
        one = load if len(load.submaps) != DRONES[load.name] else workload(load.name, seed)
        solution, association, _, _ = merged(one.submaps, Warm())
        error = rmse_to_truth(*shared(one, association, solution.state.points))
        errors.append((error, _error_of_bundle(one, _adjusted(one, {}))))
    own, full = np.array(errors).T
    return {
        'draws': draws,
        'ratio': float(np.sqrt(np.sum(own**2) / np.sum(full**2))),
        'median_ratio': float(np.median(own / full)),
    }


def _joined(load: Workload) -> Bundle:
    """All observations as one bundle: the drones' optima in the frames that the messages give."""
    from mapmerge_ros.simulation.joint import join

    cost, _, points = started(load, informed=False)
    S_map_globals = cost.frames(points)
    S_global_maps = [S_map_globals[k].inverse() for k in range(len(cost))]
    return join(load.bundles, S_global_maps, [one.point_ids for one in load.bundles])


def _adjusted(load: Workload, settings: dict[str, Any], joint: Bundle | None = None) -> Any:
    from mapmerge_ros.simulation import solve as adjust

    return adjust(joint or _joined(load), linear_solver='SPARSE_SCHUR', **settings)


def _error_of_bundle(load: Workload, solved: Any) -> float:
    ids = np.unique(np.concatenate([submap.compressed_ids for submap in load.submaps]))
    points = solved.bundle.points[solved.bundle.rows_of(ids)]
    return rmse_to_truth(points, load.points_world(ids))
