# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
The merge against the full bundle, from 4 to 1024 drones: time, memory, error to the truth.

    python benchmarks/merge.py [S1 S2 …] [--full] [--cache DIR] [--repeat N] [--page FILE]

Each measurement runs in a process of its own with one BLAS thread. CPU time is reported beside
wall time: on a busy machine only the former says something. `--full` bundles S3 too.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from workloads import DRONES, Workload, cached

from mapmerge_ros.association import associate
from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.fusion import FusionConfig, Warm, fuse
from mapmerge_ros.fusion.associate import of_compressed
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.knowledge import knowledge
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.search import search
from mapmerge_ros.fusion.verify import pool_noise, verify
from mapmerge_ros.geometry import Gauge, align

THREADS = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1')

MARK = '<!-- table of benchmarks/merge.py -->\n'

KINDS = ('nothing', 'merge', 'fuse', 'bundle')


class Clock:
    """CPU and wall seconds since it was started."""

    def __init__(self) -> None:
        self._cpu, self._wall = time.process_time(), time.perf_counter()

    def __call__(self) -> dict[str, float]:
        """Seconds since then."""
        return {
            'cpu_s': time.process_time() - self._cpu,
            'wall_s': time.perf_counter() - self._wall,
        }


def rmse_to_truth(points: Any, truth: Any) -> float:
    """Root mean square distance [m] after the best similarity onto the truth."""
    moved = align(truth, points).S_target_source.apply(points)
    return float(np.sqrt(np.mean(np.sum((moved - truth) ** 2, axis=1))))


def run_merge(load: Workload) -> dict[str, Any]:
    """Association, links, start, joint merge, test of its price: landmarks, frames, verdict."""
    config, clock = FusionConfig(), Clock()
    found = associate(load.submaps)
    association = of_compressed(load.submaps, found.tracks)
    warm = Warm()
    links = find_links(load.submaps, association, config, warm)
    noise = pool_noise(load.submaps)
    is_shared = association.views > 1
    informations = warm.informations(load.submaps)
    cost = JointCost.of(
        load.submaps, association.tracks, is_shared, noise.weights, informations
    ).reduced()
    gauges = 7 * (len(load.submaps) - 1)
    dof = 3 * int((association.views - 1).sum()) - gauges
    merged = search(
        cost,
        links,
        Gauge.SIMILARITY,
        lambda price: verify(price, dof, noise, config).accepted,
        config,
    )
    verdict, took = verify(merged.cost, dof, noise, config), clock()
    state, clock = cost.evaluate(merged.points), Clock()
    keep = np.arange(len(merged.points)) < config.max_landmarks
    known = knowledge(cost, state, Gauge.SIMILARITY, noise.sigma, keep)
    known.normal.triangle()
    knows = clock()
    ids = np.zeros(association.count, np.uint64)
    for submap, own in zip(load.submaps, association.tracks, strict=True):
        ids[own] = submap.compressed_ids
    return {
        **took,
        'knowledge_cpu_s': knows['cpu_s'],
        'iterations': merged.iterations,
        'variance_factor': verdict.variance_factor,
        'rmse_m': rmse_to_truth(merged.points, load.points_world(ids[is_shared])),
        'landmarks': len(merged.points),
    }


def run_fuse(load: Workload) -> dict[str, Any]:
    """Everything that the engine does with messages, requests and outgoing map included."""
    clock = Clock()
    fusion = fuse(load.submaps)
    took = clock()
    found = fusion.components[0]
    return {
        **took,
        'associate_s': fusion.timing.associate_s,
        'merge_s': fusion.timing.merge_s,
        'test_s': fusion.timing.test_s,
        'maps': len(found.map_ids),
        'accepted': found.verdict.accepted,
    }


def run_bundle(load: Workload) -> dict[str, Any]:
    """Ceres on all observations of all drones, from the drones' optima in the true frames."""
    from mapmerge_ros.simulation import solve
    from mapmerge_ros.simulation.joint import join

    ids = [bundle.point_ids for bundle in load.bundles]
    joint = join(load.bundles, load.S_world_maps, ids)
    clock = Clock()
    solve(joint, max_iterations=0)
    conversion, clock = clock(), Clock()
    solved = solve(joint)
    took = {name: value - conversion[name] for name, value in clock().items()}
    shared = np.unique(np.concatenate([submap.compressed_ids for submap in load.submaps]))
    points = solved.bundle.points[solved.bundle.rows_of(shared)]
    return {
        **took,
        'iterations': solved.iterations,
        'converged': solved.converged,
        'points': len(joint.point_ids),
        'keyframes': len(joint.keyframe_ids),
        'rmse_m': rmse_to_truth(points, load.points_world(shared)),
    }


def run_nothing(load: Workload) -> dict[str, Any]:
    """What the process takes before it does anything."""
    return {'maps': len(load.submaps)}


def measure(kind: str, name: str, folder: Path, repeat: int) -> dict[str, Any]:
    """One measurement in a process of its own; the median of some times."""
    command = [sys.executable, __file__, '--run', kind, name, '--cache', str(folder)]
    runs = []
    for _ in range(repeat):
        done = subprocess.run(
            command, env={**os.environ, **THREADS}, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise MapMergeError(f'{kind} of {name} failed: {done.stderr.strip()[-2000:]}')
        runs.append(json.loads(done.stdout.splitlines()[-1]))
    runs.sort(key=lambda run: run.get('cpu_s', 0.0))
    return dict(runs[len(runs) // 2])


def run(kind: str, name: str, folder: Path) -> dict[str, Any]:
    """Run in this process; memory is the growth of the peak over the loaded workload."""
    load = cached(name, folder)
    if kind != 'bundle':
        load = Workload(load.name, load.submaps, (), load.S_world_maps, load.scene_points)
    fuse(load.submaps[:2])  # libraries are loaded and warm
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = {'nothing': run_nothing, 'merge': run_merge, 'fuse': run_fuse, 'bundle': run_bundle}
    values = found[kind](load)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {**values, 'growth_mb': (after - before) / 1024.0, 'peak_mb': after / 1024.0}


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown of all results, with growth exponents between neighbours."""
    lines = [
        '| | drones | shared | merge CPU [s] | exponent | std and R̄ CPU [s] '
        '| all of `fuse` CPU [s] | peak of `fuse` [MB] '
        '| full bundle CPU [s] | bundle : merge | RMSE merge : bundle |',
        '|---|---|---|---|---|---|---|---|---|---|---|',
    ]
    last: tuple[int, float] | None = None
    for name, found in results.items():
        merge, whole, bundle = found['merge'], found['fuse'], found.get('bundle')
        seconds, drones = merge['cpu_s'], DRONES[name]
        exponent = ''
        if last:
            exponent = f'{np.log(seconds / last[1]) / np.log(drones / last[0]):.2f}'
        last = drones, seconds
        full = ('', '', '')
        if bundle:
            full = (
                f'{bundle["cpu_s"]:.1f}',
                f'{bundle["cpu_s"] / seconds:.0f}',
                f'{merge["rmse_m"] / bundle["rmse_m"]:.4f}',
            )
        cells = [
            name,
            str(drones),
            str(merge['landmarks']),
            f'{seconds:.3f}',
            exponent,
            f'{merge["knowledge_cpu_s"]:.3f}',
            f'{whole["cpu_s"]:.2f}',
            f'{whole["peak_mb"]:.0f}',
            *full,
        ]
        lines.append('| ' + ' | '.join(cells) + ' |')
    return '\n'.join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('names', nargs='*', default=list(DRONES), metavar='S1')
    parser.add_argument('--full', action='store_true', help='bundle S3 as well: minutes')
    parser.add_argument('--cache', type=Path, default=Path('build/workloads'))
    parser.add_argument('--repeat', type=int, default=5)
    parser.add_argument('--out', type=Path, help='JSON of all results')
    parser.add_argument('--page', type=Path, help='Markdown whose table at the end is renewed')
    parser.add_argument('--run', choices=KINDS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.run:
        print(json.dumps(run(args.run, args.names[0], args.cache)))
        return
    results: dict[str, dict[str, Any]] = {}
    for name in args.names:
        cached(name, args.cache)
        kinds = ['merge', 'fuse'] + ['bundle'] * (
            name in ('S1', 'S2') or (args.full and name == 'S3')
        )
        repeat = {kind: 1 if kind == 'bundle' or name == 'S5' else args.repeat for kind in kinds}
        results[name] = {kind: measure(kind, name, args.cache, repeat[kind]) for kind in kinds}
        print(json.dumps({name: results[name]}), file=sys.stderr)
    print(table(results))
    if args.page:
        head = args.page.read_text().partition(MARK)[0]
        args.page.write_text(f'{head}{MARK}\n{table(results)}\n')
    if args.out:
        args.out.write_text(json.dumps(results, indent=1) + '\n')


if __name__ == '__main__':
    main()
