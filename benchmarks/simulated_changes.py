# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the tests say of simulated changes, where everything is known.

    python benchmarks/simulated_changes.py --markdown docs/changes.md

Exactly linear merges with exactly Gaussian noise (those of the tests), and fleets of drones.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy.stats

sys.path.insert(0, str(Path(__file__).parents[1] / 'test'))
from documents import published
from gaussian_merges import draw, merged, noise, scene
from test_objects import chi2_of, with_object

from mapmerge_ros.fusion import fuse
from mapmerge_ros.fusion.honest import examine
from mapmerge_ros.fusion.local import local_tests
from mapmerge_ros.geometry import Gauge, align
from mapmerge_ros.simulation import FleetConfig, simulate_fleet

HEAD, EXAMINED = '| | asked | seen |', 200


def uniform_row(merges: int) -> str:
    """Nothing moved; of every landmark the test of one of its members, drawn at random."""
    rng = np.random.default_rng(1)
    p_values, objects = [], 0
    for seed in range(merges):
        merge = draw(seed, landmarks=60)
        tests = local_tests(merge)
        order = rng.permutation(np.flatnonzero(tests.distinct))
        _, first = np.unique(merge.members.tracks[order], return_index=True)
        p_values.append(tests.p_value[order[first]])
        if seed < EXAMINED:
            objects += bool(examine(merge, np.inf, certain=True).objects)
    every = np.concatenate(p_values)
    ks = scipy.stats.kstest(every, 'uniform').pvalue
    return (
        f'| unchanged, p-values of {len(every)} landmarks uniform | KS p ≥ 0.01 | {ks:.2f} |\n'
        f'| unchanged, linear merges without an object | ≥ 99 % | '
        f'{1 - objects / EXAMINED:.1%} of {EXAMINED} |'
    )


def fleets_row(count: int) -> str:
    """Nothing moved, but some things came and went: nothing may be reported."""
    wrong, doubtful, tested = 0, 0, 0
    for seed in range(count):
        fleet = simulate_fleet(FleetConfig(added=1, removed=1), 1000 + seed)
        submaps = [replace(submap, sigma=0.0) for submap in fleet.submaps()]
        found = fuse(submaps).components[0].examination
        wrong += bool(found.objects)
        doubtful += len(found.doubtful)
        tested += len(np.unique(found.tests.members.tracks))
    return (
        f'| fleets, one object added, one removed: none reported as moved | ≥ 99 % | '
        f'{1 - wrong / count:.1%} of {count} |\n'
        f'| the same: doubtful landmarks | – | {doubtful} of {tested} |'
    )


def singles_rows(merges: int) -> str:
    """3 of 30 landmarks of one map moved by six standard deviations."""
    rng, found, false, inside, biases = np.random.default_rng(8), 0, 0, [], []
    for _ in range(merges):
        points, members, matrices = scene(rng, landmarks=30, views=(2, 4))
        errors = noise(rng, points, members, matrices)
        tests = local_tests(merged(points, members, matrices, errors))
        moved = rng.choice(np.flatnonzero((members.maps == 1) & tests.testable), 3, replace=False)
        direction = rng.normal(size=(3, 3))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        shift = 6.0 * np.einsum(
            'sij,sj->si', np.linalg.cholesky(tests.covariance[moved]), direction
        )
        errors[moved] += shift
        result = examine(merged(points, members, matrices, errors), np.inf, certain=True)
        groups = [result.doubtful, *(each.members for each in result.objects)]
        named = np.concatenate(groups)
        found += int(np.isin(members.tracks[moved], members.tracks[named]).sum())
        false += int((~np.isin(members.tracks[named], members.tracks[moved])).sum())
        for member, true in zip(moved, shift, strict=True):
            if member in named:
                error = result.tests.displacement[member] - true
                stds = np.sqrt(np.diag(result.tests.covariance[member]))
                inside += (np.abs(error) <= 1.96 * stds).tolist()
                biases.append(error @ true / (true @ true))
    bias, spread = np.mean(biases), np.std(biases) / np.sqrt(len(biases))
    return (
        f'| 3 of 30 landmarks moved by 6 σ: found | ≥ 95 % | {found / (3 * merges):.1%} of '
        f'{3 * merges} |\n'
        f'| of the unmoved reported | ≤ 1 % | {false / (27 * merges):.2%} |\n'
        f'| displacement, relative bias | 0 | {bias:+.4f} ± {spread:.4f} |\n'
        f'| its 95 % interval covers the truth | 93–97 % | {np.mean(inside):.1%} |'
    )


def objects_rows(merges: int) -> str:
    """Ten neighbours moved by ten typical deviations and turned by 0.05 rad."""
    rng, whole, within, extra = np.random.default_rng(9), 0, 0, 0
    for _ in range(merges):
        merge, moved, truth = with_object(rng, 10.0, 0.05)
        objects = examine(merge, np.inf, certain=True).objects
        if len(objects) == 1 and np.isin(moved, objects[0].members).all():
            whole += 1
            extra += len(objects[0].members) - len(moved)
            within += chi2_of(objects[0].motion, truth) <= scipy.stats.chi2.isf(2.7e-3, 6)
    return (
        f'| an object of 10 moved and turned: all in one group | ≥ 95 % | {whole / merges:.1%} of '
        f'{merges} |\n'
        f'| its motion within its own 3 σ (6 degrees of freedom) | 99.7 % | '
        f'{within / max(1, whole):.1%} |\n'
        f'| landmarks in it that did not move | – | {extra} of {10 * whole} |'
    )


def rest_row(fleets: int) -> str:
    """Fleets with one moved object: the rest, and the same without the object."""
    ratios = []
    for seed in range(fleets):
        fleet = simulate_fleet(FleetConfig(moved=1), 500 + seed)
        submaps = list(fleet.submaps())
        gone = fleet.truth.moved[0].landmark_ids
        without = [_private(submap, np.isin(submap.landmark_ids, gone)) for submap in submaps]
        ratios.append(_rmse(submaps, fleet, gone) / _rmse(without, fleet, gone))
    return (
        f'| RMSE of the rest over that of the map without the object | within 2 % | '
        f'{sum(ratio <= 1.02 for ratio in ratios)} of {fleets}; median {np.median(ratios):.4f}, '
        f'largest {max(ratios):.4f} |'
    )


def _private(submap, rows):
    """The same sub-map with ids of its own for some landmarks."""
    ids = submap.landmark_ids.copy()
    stamp = np.uint64(10_000_000 * (1 + int(submap.map_id.partition('/')[0][-1])))
    ids[rows] += stamp
    return replace(submap, landmark_ids=ids)


def _rmse(submaps, fleet, gone) -> float:
    """Of the landmarks of two or more sub-maps but those of the object, after a similarity."""
    component = fuse(submaps).components[0]
    landmarks = component.landmarks
    views = np.bincount(landmarks.member_rows, minlength=len(landmarks.ids))
    use = np.isin(landmarks.ids, fleet.truth.scene.ids) & ~np.isin(landmarks.ids, gone)
    use &= views > 1
    truth = fleet.truth.points_world(landmarks.ids[use])
    points = landmarks.points_global[use]
    found = align(truth, points, gauge=Gauge.SIMILARITY).S_target_source.apply(points)
    return float(np.sqrt(np.mean(np.sum((found - truth) ** 2, axis=1))))


def rows() -> Iterator[str]:
    """Every row of the table."""
    yield uniform_row(1700)
    yield singles_rows(300)
    yield objects_rows(100)
    yield fleets_row(100)
    yield rest_row(20)


def main(argv: list[str] | None = None) -> int:
    """Print the table, and write it into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--markdown', type=Path, help='document whose table is replaced')
    args = parser.parse_args(argv)
    head = [HEAD, '|---|---|---|']
    return published(lambda: itertools.chain(head, rows()), args.markdown, 'simulated')


if __name__ == '__main__':
    sys.exit(main())
