# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The full bundle over all observations, which the merge is held to."""

from __future__ import annotations

import ctypes
import itertools
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from merge_steps import CONFIG, Values, ids_of_tracks, merged, rmse_to_truth, started, timed
from workloads import DRONES, Workload, workload

from mapmerge_ros.arrays import Floats, Ids
from mapmerge_ros.bundle import Bundle, MapName
from mapmerge_ros.fusion import Warm
from mapmerge_ros.fusion.refine import Robot, refine

BUNDLE_SECONDS = 360.0
"""Time limit of the full bundle: S4 needs most of it, or more."""

NEARLY = 1.01
"""Cost over the final one from which the bundle is nearly done."""

ACCURACY_PAIRS = {'S1': 10, 'S2': 4, 'S3': 3, 'S4': 1}
"""
Draws of scene and noise, each with its mirror image, whose squared errors are pooled.

Merge and bundle are d apart, of second order in the noise. In the ratio of their errors that is
d'e / e'e, which is odd in the noise: 2 % up or down at S3, whichever of the two is better. Noise
of the opposite sign takes it out.
"""


def bundle(load: Workload, repeats: int) -> Values:
    """Ceres on all observations of all drones, from generalised Procrustes of the messages."""
    joint, limit = _joined(load), {'max_seconds': BUNDLE_SECONDS, 'progress': True}
    made, _ = timed(1, lambda _: _adjusted(load, {'max_iterations': 0}, joint))
    with standard_output() as written:
        took, solved = timed(repeats, lambda _: _adjusted(load, limit, joint))
    ids = np.unique(np.concatenate([submap.compressed_ids for submap in load.submaps]))
    rows = solved.bundle.rows_of(ids)
    return {
        **{name: value - made[name] for name, value in took.items()},
        'iterations': solved.iterations,
        'converged': solved.converged,
        'nearly_s': seconds_until(written[0], NEARLY),
        'near_share': share_until(
            written[0], CONFIG.convergence, joint.residual_count - joint.dof
        ),
        'points': len(joint.point_ids),
        'keyframes': len(joint.keyframe_ids),
        'observation_bytes': 12.0 * len(joint.observations_px) / len(load.submaps),
        'rmse_m': rmse_to_truth(solved.bundle.points[rows], load.points_world(ids)),
    }


COLUMNS = 10
"""Of Ceres' table of steps: number, cost, six others, seconds of the step and of all so far."""


def accuracy(load: Workload, repeats: int) -> Values:
    """
    Error to the truth over that of the full bundle, over pairs of draws with opposite noise.

    Before and after one round with the robots; how far apart from the bundle the landmarks are is
    over its error as well.
    """
    count = len(load.submaps)
    pairs = ACCURACY_PAIRS.get(load.name, repeats) if count == DRONES[load.name] else repeats
    squares = []
    for seed, mirrored in itertools.product(range(pairs), (False, True)):
        one = workload(load.name, seed, drones=count, mirrored=mirrored)
        solution, association, _, _ = merged(one.submaps, Warm())
        ids, points = ids_of_tracks(one, association), solution.state.points
        truth, solved = one.points_world(ids), _adjusted(one, {}).bundle
        full = solved.points[solved.rows_of(ids)]
        refined = _after_a_round(one, ids)
        pairings = (
            (points, full),
            (refined, full),
            (points, truth),
            (refined, truth),
            (full, truth),
        )
        squares.append([rmse_to_truth(*each) ** 2 for each in pairings])
    apart, apart_after, own, after, bundled = np.sum(squares, axis=0)
    return {
        'draws': 2 * pairs,
        'ratio': float(np.sqrt(own / bundled)),
        'ratio_after_a_round': float(np.sqrt(after / bundled)),
        'apart': float(np.sqrt(apart / bundled)),
        'apart_after_a_round': float(np.sqrt(apart_after / bundled)),
        'ratios': [float(np.sqrt(one[2] / one[4])) for one in squares],
    }


def seconds_until(tables: str, share: float) -> float:
    """Seconds until the cost was within a share of its last one, by the last of Ceres' tables."""
    steps = _steps(tables)
    lowest = min(cost for cost, _, _ in steps)
    return next(seconds for cost, _, seconds in steps if cost <= share * lowest)


def share_until(tables: str, convergence: float, redundancy: int) -> float:
    """
    Share of its seconds until it was as near to its optimum as the merge ends to its own.

    So many standard deviations in the worst direction, as what was left to be gained says.
    """
    steps = _steps(tables)
    limit = convergence**2 * min(cost for cost, _, _ in steps) / redundancy
    gains = np.maximum([gain for _, gain, _ in steps], 0.0)
    left = np.cumsum(gains[::-1])[::-1] - gains
    seconds = [after for _, _, after in steps]
    return seconds[int(np.argmax(left <= limit))] / seconds[-1]


def _steps(tables: str) -> list[tuple[float, float, float]]:
    """Cost, its decrease, and seconds of all so far, after each step of the last table."""
    steps: list[tuple[float, float, float]] = []
    for row in (line.split() for line in tables.splitlines()):
        if len(row) == COLUMNS and row[0].isdigit():
            steps = [] if row[0] == '0' else steps
            steps.append((float(row[1]), float(row[2]), float(row[-1])))
    return steps


@contextmanager
def standard_output() -> Iterator[list[str]]:
    """Fill a list with what the process writes there meanwhile, libraries in C included."""
    written, kept = list[str](), os.dup(1)
    flush = ctypes.CDLL(None).fflush
    with tempfile.TemporaryFile('w+') as file:
        sys.stdout.flush()
        flush(None)
        os.dup2(file.fileno(), 1)
        try:
            yield written
        finally:
            flush(None)
            os.dup2(kept, 1)
            os.close(kept)
        file.seek(0)
        written.append(file.read())


def _after_a_round(load: Workload, ids: Ids) -> Floats:
    """Landmarks when each robot has linearised again where the first merge had them."""
    robots = [
        Robot(
            MapName(submap.map_id, submap.robot_id, stamp_ns=submap.stamp_ns, id_space='fleet'),
            bundle,
            submap.compressed_ids,
        )
        for submap, bundle in zip(load.submaps, load.bundles, strict=True)
    ]
    landmarks = refine(robots, 2)[1][-1].fusion.components[0].landmarks
    return landmarks.points_global[np.searchsorted(landmarks.ids, ids)]


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
