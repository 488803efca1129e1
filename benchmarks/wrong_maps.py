# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Sub-maps that are wrong as a whole: how often they are named, and how often one that is right.

    python benchmarks/wrong_maps.py ../shared/data --markdown docs/changes.md

Simulated fleets whose sub-maps are drawn again and again from their own R (exactly Gaussian), and
draws of real sets of three sub-maps or more; in each, one sub-map is damaged.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from data_sets import data_sets
from documents import published
from honest_tests import CHOSEN_ON, bent, corrupt, draw, load
from scipy.spatial.transform import Rotation

from mapmerge_ros.bundle.bundle import FramePrior
from mapmerge_ros.fusion import Fusion, fuse
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.simulation import Fleet, FleetConfig, simulate_fleet
from mapmerge_ros.simulation.drones import Sensing
from mapmerge_ros.submap import SubMap

HEAD = '| maps | what is wrong with one | merges | named | another named | accepted | s a merge |'

DRONES, FLEETS, UNCHANGED = 6, 4, 200
"""Sub-maps of a fleet, fleets, and unchanged merges; every fleet is drawn anew each time."""

SCALE, BEND, NOISE, PART, JITTER = 1.03, 0.1, 3.0, 0.3, 0.05
"""The damages of issue 5; a corrupt part is that share, off by that share of the map's extent."""

PRIOR = FramePrior(scale_std_ratio=0.003)
"""Of the metric maps, a stereo rig's; one that knows its scale to 1 % only may be off by 3 %."""

Damage = Callable[[SubMap, np.random.Generator], SubMap]


def drawn_again(fleet: Fleet, rng: np.random.Generator) -> list[SubMap]:
    """Sub-maps about the truth, their errors as R claims."""
    submaps = []
    for k, submap in enumerate(fleet.submaps(catalogue=False)):
        bundle, true_bundle = fleet.bundles[k], fleet.truth.bundles[k]
        rows = bundle.rows_of(submap.compressed_ids)
        S_world_map = fleet.truth.S_world_map[k]
        points = S_world_map.inverse().apply(true_bundle.points[rows])
        white = (submap.sigma or 1.0) * rng.normal(size=submap.rank)
        errors = np.linalg.lstsq(submap.triangle(), white, rcond=None)[0].reshape(-1, 3)
        submaps.append(replace(submap, points=points + errors, c=np.zeros_like(submap.c)))
    return submaps


def scaled(submap: SubMap, rng: np.random.Generator) -> SubMap:
    """Wrong scale."""
    return replace(submap, points=SCALE * submap.points)


def bent_map(submap: SubMap, rng: np.random.Generator) -> SubMap:
    """Bent into a bowl."""
    return bent([submap], BEND, rng)[0]


def off(submap: SubMap, rng: np.random.Generator) -> SubMap:
    """Every landmark off by several times its noise."""
    return corrupt([submap], NOISE, rng)[0]


def in_part(submap: SubMap, rng: np.random.Generator) -> SubMap:
    """Landmarks about one of them are anywhere nearby."""
    points = submap.points.copy()
    distances = np.linalg.norm(points - points[rng.integers(len(points))], axis=1)
    near = np.argsort(distances)[: int(PART * len(points))]
    extent = np.linalg.norm(np.std(points, axis=0))
    points[near] += JITTER * extent * rng.normal(size=(len(near), 3))
    return replace(submap, points=points)


def turned(submap: SubMap, rng: np.random.Generator) -> SubMap:
    """Landmarks turned, R not: what is known well is claimed of the wrong directions."""
    return replace(submap, points=submap.points @ Rotation.random(rng=rng).as_matrix().T)


@dataclass(frozen=True, slots=True)
class Case:
    """One kind of damage, in maps of one gauge."""

    what: str
    damage: Damage
    gauge: Gauge = Gauge.SIMILARITY


CASES = (
    Case('3 % wrong scale, metric maps', scaled, Gauge.RIGID),
    Case('bent by 10 % of half its length', bent_map),
    Case('off by 3 times its noise', off),
    Case('a third of its landmarks corrupt', in_part),
    Case('landmarks turned, R not', turned),
)


@dataclass(slots=True)
class Tally:
    """What came of merges in which one sub-map was damaged."""

    merges: int = 0
    named: int = 0
    others: int = 0
    accepted: int = 0
    """With the damaged one inside"""
    seconds: float = 0.0

    def add(self, fusion: Fusion, culprit: str, seconds: float) -> None:
        """Count one."""
        names = {item.submap.map_id for item in fusion.quarantined}
        self.merges += 1
        self.named += culprit in names
        self.others += bool(names - {culprit})
        inside = bool(fusion.components) and culprit in fusion.components[0].map_ids
        self.accepted += inside and fusion.verdict.accepted
        self.seconds += seconds

    def row(self, maps: str, what: str) -> str:
        """One row of the table."""
        n = self.merges
        named = f'{self.named / n:.0%}' if what != 'nothing' else '–'
        accepted = f'{self.accepted / n:.0%}' if what != 'nothing' else '–'
        return (
            f'| {maps} | {what} | {n} | {named} | {self.others / n:.1%} | {accepted} | '
            f'{self.seconds / n:.2f} |'
        )


def timed(submaps: list[SubMap]) -> tuple[Fusion, float]:
    """Fusion, and the CPU time that it took."""
    begin = time.process_time()
    return fuse(submaps), time.process_time() - begin


def simulated_rows(trials: int) -> Iterator[str]:
    """Fleets of Gaussian sub-maps."""
    fleets = {
        gauge: [
            simulate_fleet(
                FleetConfig(drones=DRONES, sensing=Sensing(gauge=gauge, prior=PRIOR)), 70 + seed
            )
            for seed in range(FLEETS)
        ]
        for gauge in (Gauge.SIMILARITY, Gauge.RIGID)
    }
    maps, tally = f'{DRONES} simulated', Tally()
    for seed in range(UNCHANGED):
        fleet = fleets[Gauge.SIMILARITY if seed % 2 else Gauge.RIGID][seed // 2 % FLEETS]
        tally.add(*_unchanged(drawn_again(fleet, np.random.default_rng([1, seed]))))
    yield tally.row(maps, 'nothing')
    for at, case in enumerate(CASES):
        tally = Tally()
        for seed in range(trials):
            rng = np.random.default_rng([2, at, seed])
            submaps = drawn_again(fleets[case.gauge][seed % FLEETS], rng)
            _damage(submaps, int(rng.integers(DRONES)), case, rng, tally)
        yield tally.row(maps, case.what)


def real_rows(folder: Path, trials: int) -> Iterator[str]:
    """Draws of one real set."""
    bundles, shared = load(folder, all_tracks=False)
    if len(bundles) < 3:
        return
    name = folder.name + ('' if folder.name in CHOSEN_ON else ' (check)')
    draws, tally = [draw(bundles, shared, seed) for seed in range(3)], Tally()
    for submaps in draws:
        tally.add(*_unchanged(submaps))
    yield tally.row(name, 'nothing')
    for at, case in enumerate(CASES):
        if case.gauge is not Gauge.SIMILARITY:
            continue
        tally = Tally()
        for seed in range(trials):
            rng = np.random.default_rng([3, at, seed])
            submaps = list(draws[seed % 3])
            _damage(submaps, seed % len(submaps), case, rng, tally)
        yield tally.row(name, case.what)


def _unchanged(submaps: list[SubMap]) -> tuple[Fusion, str, float]:
    fusion, seconds = timed(submaps)
    return fusion, '', seconds


def _damage(
    submaps: list[SubMap], k: int, case: Case, rng: np.random.Generator, tally: Tally
) -> None:
    submaps[k] = case.damage(submaps[k], rng)
    fusion, seconds = timed(submaps)
    tally.add(fusion, submaps[k].map_id, seconds)


def rows(folders: list[Path], trials: int) -> Iterator[str]:
    """Every row of the table."""
    yield from simulated_rows(trials)
    for folder in folders:
        yield from real_rows(folder, trials)


def main(argv: list[str] | None = None) -> int:
    """Print the table, and write it into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', type=Path, help='folder with one folder per data set')
    parser.add_argument('--trials', type=int, default=20, help='per set and damage')
    parser.add_argument('--markdown', type=Path, help='document whose table is replaced')
    args = parser.parse_args(argv)
    head = [HEAD, '|---' * (HEAD.count(' |')) + '|']
    return published(
        lambda: itertools.chain(head, rows(data_sets(args.data), args.trials)),
        args.markdown,
        'wrong maps',
    )


if __name__ == '__main__':
    sys.exit(main())
