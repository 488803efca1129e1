# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What `merge.py` measures, one function each: of a workload and a number of repeats, values."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from workloads import Workload, sessions

from mapmerge_ros.arrays import Ids
from mapmerge_ros.association import associate
from mapmerge_ros.bundle import Bundle, MapName, compress
from mapmerge_ros.fusion import FusionConfig, Warm, fuse
from mapmerge_ros.fusion.associate import Association, of_compressed
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.knowledge import knowledge
from mapmerge_ros.fusion.joint.start import initial_points
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.merge import merge as merge_densely
from mapmerge_ros.fusion.overlap import Link, spanning_tree
from mapmerge_ros.fusion.solution import Anchor, Solution, solve
from mapmerge_ros.fusion.verify import Noise, pool_noise, verify
from mapmerge_ros.geometry import Gauge, Similarity, align
from mapmerge_ros.io import encode_submap
from mapmerge_ros.submap import SubMap

Values = dict[str, Any]

CONFIG = FusionConfig()

BUNDLE_SECONDS = 360.0
"""Time limit of the full bundle: S4 does not converge in it."""


def timed(repeats: int, run: Callable[[int], Any]) -> tuple[Values, Any]:
    """Median CPU and wall seconds of `run(0)`, `run(1)`, … and what the last one returned."""
    cpu, wall, result = [], [], None
    for k in range(repeats):
        result = None  # its memory is free before the next one
        before = time.process_time(), time.perf_counter()
        result = run(k)
        cpu.append(time.process_time() - before[0])
        wall.append(time.perf_counter() - before[1])
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


def merge(load: Workload, repeats: int) -> Values:
    """Association, links, start, joint merge and the test of its price, from scratch."""

    def run(_: int) -> Any:
        found = merged(load.submaps, Warm())
        verify(found[0].estimate.cost, found[0].dof, found[3], CONFIG)
        return found

    took, (solution, association, _, noise) = timed(repeats, run)
    return {
        **took,
        'iterations': solution.estimate.iterations,
        'variance_factor': solution.estimate.cost / (solution.dof * noise.sigma**2),
        'rmse_m': rmse_to_truth(*_shared(load, association, solution.state.points)),
        'landmarks': association.count,
        'message_bytes': float(np.mean([len(encode_submap(one)) for one in load.submaps])),
    }


def rewarm(load: Workload, repeats: int) -> Values:
    """One sub-map replaced by its next revision, and back; the others and the memory stay."""
    k = [submap.map_id for submap in load.submaps].index(load.revised.map_id)
    sets = [
        (*load.submaps[:k], one, *load.submaps[k + 1 :]) for one in (load.revised, load.submaps[k])
    ]
    warm = Warm()
    merged(load.submaps, warm)
    took, (solution, *_) = timed(repeats, lambda turn: merged(sets[turn % 2], warm))
    expected = merged(sets[(repeats - 1) % 2], Warm())[0]
    S = align(expected.state.points, solution.state.points).S_target_source
    apart = np.abs(S.apply(solution.state.points) - expected.state.points).max()
    return {**took, 'iterations': solution.estimate.iterations, 'apart_m': float(apart)}


def known(load: Workload, repeats: int) -> Values:
    """Standard deviations of all landmarks, frames' covariances, R̄ of the kept ones."""
    solution, _, _, noise = merged(load.submaps, Warm())
    keep = np.arange(len(solution.state.points)) < CONFIG.max_landmarks

    def run(_: int) -> None:
        found = knowledge(solution.cost, solution.state, Gauge.SIMILARITY, noise.sigma, keep)
        found.normal.triangle()

    return timed(repeats, run)[0]


def whole(load: Workload, repeats: int) -> Values:
    """Everything that the engine does with messages, requests and outgoing map included."""
    took, fusion = timed(repeats, lambda _: fuse(load.submaps))
    component = fusion.components[0]
    return {**took, 'maps': len(component.map_ids), 'accepted': component.verdict.accepted}


def procrustes(load: Workload, repeats: int) -> Values:
    """Frames along the tree, then generalised Procrustes: where the merge starts."""

    def run(_: int) -> Any:
        cost, association, links, _ = _problem(load)
        gauges = [submap.gauge for submap in load.submaps]
        centre, frames = spanning_tree(range(len(cost)), gauges, links)
        return initial_points(cost, frames, centre), association

    took, (points, association) = timed(repeats, run)
    return {**took, 'rmse_m': rmse_to_truth(*_shared(load, association, points))}


def dense(load: Workload, repeats: int) -> Values:
    """The plain merge with dense matrices, from the same start."""

    def run(_: int) -> Any:
        cost, association, links, _ = _problem(load)
        gauges = [submap.gauge for submap in load.submaps]
        centre, frames = spanning_tree(range(len(cost)), gauges, links)
        start = initial_points(cost, frames, centre)
        found = merge_densely(cost.elements(), start, Gauge.SIMILARITY, CONFIG)
        return found, association

    took, (found, association) = timed(repeats, run)
    return {**took, 'rmse_m': rmse_to_truth(*_shared(load, association, found.points))}


def bundle(load: Workload, repeats: int) -> Values:
    """Ceres on all observations of all drones, from the drones' optima in the true frames."""
    from mapmerge_ros.simulation import solve as adjust
    from mapmerge_ros.simulation.joint import join

    joint = join(load.bundles, load.S_world_maps, [one.point_ids for one in load.bundles])
    settings: dict[str, Any] = {'linear_solver': 'SPARSE_SCHUR', 'max_seconds': BUNDLE_SECONDS}
    made, _ = timed(1, lambda _: adjust(joint, max_iterations=0, **settings))
    took, solved = timed(repeats, lambda _: adjust(joint, **settings))
    shared = np.unique(np.concatenate([submap.compressed_ids for submap in load.submaps]))
    points = solved.bundle.points[solved.bundle.rows_of(shared)]
    return {
        **{name: value - made[name] for name, value in took.items()},
        'iterations': solved.iterations,
        'converged': solved.converged,
        'points': len(joint.point_ids),
        'keyframes': len(joint.keyframe_ids),
        'observation_bytes': 12.0 * len(joint.observations_px) / len(load.submaps),
        'rmse_m': rmse_to_truth(points, load.points_world(shared)),
    }


def compression(_: Workload | None, repeats: int) -> Values:
    """Sessions compressed as they are shipped, each beside one dense QR of everything."""
    return {
        'choices': [
            {'choice': choice, **_compressed(drone, ids, repeats)}
            for choice, (drone, ids) in sessions().items()
        ]
    }


def _compressed(drone: Bundle, ids: Ids, repeats: int) -> Values:
    name = MapName('session/0001', 'session')
    took, fast = timed(repeats, lambda _: compress(drone, name, ids, catalogue=False, dtype=float))
    dense_took, plain = timed(
        1,
        lambda _: compress(drone, name, ids, catalogue=False, method='dense', dtype=float),
    )
    expected = plain.triangle().T @ plain.triangle()
    difference = np.abs(fast.triangle().T @ fast.triangle() - expected).max()
    return {
        **took,
        'dense_cpu_s': dense_took['cpu_s'],
        'difference': float(difference / np.abs(expected).max()),
        'keyframes': len(drone.keyframe_ids),
        'points': len(drone.point_ids),
        'landmarks': len(ids),
    }


def _problem(load: Workload) -> tuple[JointCost, Association, tuple[Link, ...], Noise]:
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
    return cost, association, links, noise


def _shared(load: Workload, association: Association, points: Any) -> tuple[Any, Any]:
    """Landmarks of several sub-maps and where they are in truth; all compressed ones are."""
    ids = np.zeros(association.count, np.uint64)
    for submap, own in zip(load.submaps, association.tracks, strict=True):
        ids[own] = submap.compressed_ids
    return points, load.points_world(ids)


KINDS: dict[str, Callable[[Workload, int], Values]] = {
    'merge': merge,
    'rewarm': rewarm,
    'known': known,
    'whole': whole,
    'procrustes': procrustes,
    'dense': dense,
    'bundle': bundle,
}
