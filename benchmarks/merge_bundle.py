# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The full bundle over all observations, which the merge is held to."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from merge_steps import Values, ids_of_tracks, merged, rmse_to_truth, started, timed
from workloads import Workload, workload

from mapmerge_ros.bundle import Bundle
from mapmerge_ros.fusion import Warm
from mapmerge_ros.geometry import align

BUNDLE_SECONDS = 360.0
"""Time limit of the full bundle: S4 needs most of it, or more."""

ACCURACY_PAIRS = {'S1': 10, 'S2': 4, 'S3': 3, 'S4': 1}
"""
Draws of scene and noise, each with its mirror image, whose squared errors are pooled.

Merge and bundle are d apart, of second order in the noise. In the ratio of their errors that is
d'e / e'e, which is odd in the noise: 2 % up or down at S3, whichever of the two is better. Noise
of the opposite sign takes it out.
"""


def bundle(load: Workload, repeats: int) -> Values:
    """Ceres on all observations of all drones, from generalised Procrustes of the messages."""
    joint, limit = _joined(load), {'max_seconds': BUNDLE_SECONDS}
    made, _ = timed(1, lambda _: _adjusted(load, {'max_iterations': 0}, joint))
    took, solved = timed(repeats, lambda _: _adjusted(load, limit, joint))
    ids = np.unique(np.concatenate([submap.compressed_ids for submap in load.submaps]))
    rows = solved.bundle.rows_of(ids)
    return {
        **{name: value - made[name] for name, value in took.items()},
        'iterations': solved.iterations,
        'converged': solved.converged,
        'points': len(joint.point_ids),
        'keyframes': len(joint.keyframe_ids),
        'observation_bytes': 12.0 * len(joint.observations_px) / len(load.submaps),
        'rmse_m': rmse_to_truth(solved.bundle.points[rows], load.points_world(ids)),
    }


def accuracy(load: Workload, repeats: int) -> Values:
    """Error to the truth over that of the full bundle, over pairs of draws with opposite noise."""
    pairs, squares = ACCURACY_PAIRS.get(load.name, repeats), []
    for seed, mirrored in itertools.product(range(pairs), (False, True)):
        one = workload(load.name, seed, drones=len(load.submaps), mirrored=mirrored)
        solution, association, _, _ = merged(one.submaps, Warm())
        ids, points = ids_of_tracks(one, association), solution.state.points
        truth, solved = one.points_world(ids), _adjusted(one, {}).bundle
        full = solved.points[solved.rows_of(ids)]
        points = align(full, points).S_target_source.apply(points)
        squares.append([rmse_to_truth(*each) ** 2 for each in ((points, truth), (full, truth))])
        squares[-1].append(np.mean(np.sum((points - full) ** 2, axis=1)))
    own, bundled, apart = np.sum(squares, axis=0)
    return {
        'draws': 2 * pairs,
        'ratio': float(np.sqrt(own / bundled)),
        'apart': float(np.sqrt(apart / bundled)),
        'ratios': [float(np.sqrt(own / bundled)) for own, bundled, _ in squares],
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
