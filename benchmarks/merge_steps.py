# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The steps that measurements of the merge share."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from workloads import Workload

from mapmerge_ros.arrays import Ids
from mapmerge_ros.association import associate
from mapmerge_ros.fusion import FusionConfig, Warm
from mapmerge_ros.fusion.associate import Association, of_compressed
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.knowledge import Knowledge, knowledge
from mapmerge_ros.fusion.joint.start import initial_points
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.noise import Noise, pool_noise
from mapmerge_ros.fusion.overlap import Link, spanning_tree
from mapmerge_ros.fusion.solution import Anchor, Solution, solve
from mapmerge_ros.geometry import Gauge, Similarity, align
from mapmerge_ros.submap import SubMap

Values = dict[str, Any]

CONFIG = FusionConfig()


def timed(
    repeats: int, run: Callable[[int], Any], after: Callable[[Any], None] = lambda _: None
) -> tuple[Values, Any]:
    """
    Median CPU and wall seconds of `run(0)`, `run(1)`, … and what the last one returned.

    `after` gets what each returned, in time that is not counted.
    """
    cpu, wall, result = [], [], None
    for k in range(repeats):
        result = None  # its memory is free before the next one
        before = time.process_time(), time.perf_counter()
        result = run(k)
        cpu.append(time.process_time() - before[0])
        wall.append(time.perf_counter() - before[1])
        after(result)
    return {'cpu_s': float(np.median(cpu)), 'wall_s': float(np.median(wall))}, result


def rmse_to_truth(points: Any, truth: Any) -> float:
    """Root mean square distance [m] after the best similarity onto the truth."""
    moved = align(truth, points).S_target_source.apply(points)
    return float(np.sqrt(np.mean(np.sum((moved - truth) ** 2, axis=1))))


def merged(
    submaps: Sequence[SubMap], warm: Warm
) -> tuple[Solution, Association, tuple[Link, ...], Noise]:
    """From decoded messages to landmarks, frames and price: what `fuse` does up to its test."""
    found = associate(submaps, memory=warm)
    association = of_compressed(submaps, found.tracks)
    links = find_links(submaps, association, CONFIG, warm)
    noise = pool_noise(submaps)
    anchor = Anchor(submaps[0].map_id, Similarity.identity())
    return (
        solve(submaps, association, links, noise, anchor, CONFIG, warm),
        association,
        links,
        noise,
    )


def known(solution: Solution, noise: Noise) -> Knowledge:
    """Standard deviations, frames' covariances and the outgoing map, as `fuse` goes on."""
    keep = np.arange(len(solution.state.points)) < CONFIG.max_landmarks
    return knowledge(solution.cost, solution.state, Gauge.SIMILARITY, noise.sigma, keep)


def started(load: Workload, *, informed: bool) -> tuple[JointCost, Association, Any]:
    """
    The joint cost, and landmarks by generalised Procrustes.

    Where the merge starts if `informed`; else from positions alone, equally good in all
    directions, as somebody does it who has no R.
    """
    warm = Warm()
    association = of_compressed(load.submaps, associate(load.submaps).tracks)
    links = find_links(load.submaps, association, CONFIG, warm)
    noise = pool_noise(load.submaps)
    cost = JointCost.of(
        load.submaps,
        association.tracks,
        association.views > 1,
        noise.weights,
        warm.informations(load.submaps),
    )
    gauges = [submap.gauge for submap in load.submaps]
    centre, frames = spanning_tree(range(len(cost)), gauges, links)
    plain = replace(cost, information=cost.weights[:, None, None] * np.eye(3))
    return cost, association, initial_points(cost if informed else plain, frames, centre)


def shared(load: Workload, association: Association, points: Any) -> tuple[Any, Any]:
    """Landmarks of several sub-maps and where they are in truth; all compressed ones are."""
    return points, load.points_world(ids_of_tracks(load, association))


def ids_of_tracks(load: Workload, association: Association) -> Ids:
    """The id (tracks,) that every landmark has in all sub-maps."""
    ids: Ids = np.zeros(association.count, np.uint64)
    for submap, own in zip(load.submaps, association.tracks, strict=True):
        ids[own] = submap.compressed_ids
    return ids
