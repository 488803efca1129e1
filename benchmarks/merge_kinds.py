# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What `merge.py` measures, one function each: of a workload and a number of repeats, values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from merge_bundle import accuracy, bundle
from merge_steps import CONFIG, Values, known, merged, rmse_to_truth, shared, started, timed
from workloads import Workload

from mapmerge_ros.fusion import Warm, fuse
from mapmerge_ros.fusion.joint.near_optimum import near_optimum
from mapmerge_ros.fusion.local import sensitivity
from mapmerge_ros.fusion.merge import merge as merge_densely
from mapmerge_ros.fusion.objects import LEAST_STATISTIC, find_objects
from mapmerge_ros.fusion.verify import verify
from mapmerge_ros.geometry import Gauge, align
from mapmerge_ros.io import encode_submap


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
        'rmse_m': rmse_to_truth(*shared(load, association, solution.state.points)),
        'landmarks': association.count,
        'message_bytes': float(np.mean([len(encode_submap(one)) for one in load.submaps])),
    }


def rewarm(load: Workload, repeats: int) -> Values:
    """
    One sub-map replaced by its next revision, and back; the others and the memory stay.

    Between two merges covariances are made, as always, and the factor at the optimum with them.
    """
    k = [submap.map_id for submap in load.submaps].index(load.revised.map_id)
    sets = [
        (*load.submaps[:k], one, *load.submaps[k + 1 :]) for one in (load.revised, load.submaps[k])
    ]
    warm = Warm()

    def remember(found: Any) -> None:
        solution, _, _, noise = found
        factor = known(solution, noise).factor
        if factor is not None:
            warm.learn_merge(solution.resumable(factor))

    remember(merged(load.submaps, warm))
    took, (solution, *_) = timed(repeats, lambda turn: merged(sets[turn % 2], warm), remember)
    expected = merged(sets[(repeats - 1) % 2], Warm())[0]
    S = align(expected.state.points, solution.state.points).S_target_source
    apart = np.abs(S.apply(solution.state.points) - expected.state.points).max()
    return {**took, 'iterations': solution.estimate.iterations, 'apart_m': float(apart)}


def uncertain(load: Workload, repeats: int) -> Values:
    """Standard deviations of all landmarks, frames' covariances, R̄ of the kept ones."""
    solution, _, _, noise = merged(load.submaps, Warm())
    return timed(repeats, lambda _: known(solution, noise).normal.triangle())[0]


def whole(load: Workload, repeats: int) -> Values:
    """Everything that the engine does with messages, requests and outgoing map included."""
    took, fusion = timed(repeats, lambda _: fuse(load.submaps))
    component = fusion.components[0]
    return {**took, 'maps': len(component.map_ids), 'accepted': component.verdict.accepted}


def procrustes(load: Workload, repeats: int) -> Values:
    """Frames along the tree, then generalised Procrustes of positions."""

    def run(_: int) -> Any:
        _, association, points = started(load, informed=False)
        return points, association

    took, (points, association) = timed(repeats, run)
    return {**took, 'rmse_m': rmse_to_truth(*shared(load, association, points))}


def dense(load: Workload, repeats: int) -> Values:
    """The plain merge with dense matrices, from the same start."""

    def run(_: int) -> Any:
        cost, association, start = started(load, informed=True)
        found = merge_densely(cost.elements(), start, Gauge.SIMILARITY, CONFIG)
        return found, association

    took, (found, association) = timed(repeats, run)
    return {**took, 'rmse_m': rmse_to_truth(*shared(load, association, found.points))}


def local(load: Workload, repeats: int) -> Values:
    """Tests of every landmark of every sub-map; besides, the scan for objects among them."""
    solution, _, _, noise = merged(load.submaps, Warm())
    cost, points = solution.reduced, solution.estimate.points

    def run(_: int) -> Any:
        merge = near_optimum(cost, cost.evaluate(points), Gauge.SIMILARITY, noise.sigma)
        state = sensitivity(merge, noise.estimated_from or np.inf)
        return state, state.tests()

    took, (state, tests) = timed(repeats, run)
    scanned, objects = timed(repeats, lambda _: find_objects(state, points, LEAST_STATISTIC))
    return {
        **took,
        'scan_cpu_s': scanned['cpu_s'],
        'tests': int(tests.distinct.sum()),
        'objects': len(objects),
    }


KINDS: dict[str, Callable[[Workload, int], Values]] = {
    'merge': merge,
    'rewarm': rewarm,
    'known': uncertain,
    'whole': whole,
    'procrustes': procrustes,
    'dense': dense,
    'bundle': bundle,
    'local': local,
    'accuracy': accuracy,
}
