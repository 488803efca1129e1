# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
A robot some of whose landmark ids are those of other points: who is merged, who is kept out.

    python benchmarks/wrong_ids.py --markdown docs/changes.md

Simulated fleets; every sub-map of each is the wrong one in turn. Ids of a share of its compressed
landmarks are dealt out anew among them.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from documents import published

from mapmerge_ros.fusion import Fusion, State, fuse
from mapmerge_ros.geometry import scene_radius
from mapmerge_ros.simulation import FleetConfig, simulate_fleet
from mapmerge_ros.submap import SubMap

HEAD = (
    '| wrong ids | merges | merged where it belongs | merged elsewhere | kept out | '
    'another one kept out | s a merge | longest |'
)

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0)
FLEETS, DRONES = 5, 4

OFF = 0.02
"""Median distance from where it belongs, over the radius of the map, from which a map is wrong."""


@dataclass(frozen=True, slots=True)
class Case:
    """What became of one fusion in which one sub-map had wrong ids."""

    merged: bool
    misplaced: int
    """Sub-maps that are merged where they do not belong"""
    innocent: int
    """Other sub-maps that are not merged"""
    seconds: float
    """CPU"""


def renumbered(submap: SubMap, share: float, rng: np.random.Generator) -> SubMap:
    """Compressed ids of a share of the landmarks dealt out anew among them."""
    ids = submap.landmark_ids.copy()
    some = rng.permutation(submap.compressed_count)[: round(share * submap.compressed_count)]
    ids[some] = np.roll(ids[some], 1)
    return replace(submap, landmark_ids=ids)


def judged(fusion: Fusion, right: Fusion, culprit: str, seconds: float) -> Case:
    """Compare with the fusion of the same sub-maps with right ids."""
    merged = {item.submap.map_id for item in fusion.alignments if item.state is State.MERGED}
    others = {item.submap.map_id for item in right.alignments} - {culprit}
    return Case(culprit in merged, len(misplaced(fusion, right)), len(others - merged), seconds)


def misplaced(fusion: Fusion, right: Fusion) -> list[str]:
    """Sub-maps that are not where they belong, as most of the merged ones see it."""
    belongs = {item.submap.map_id: item for item in right.alignments}
    merged = [item for item in fusion.alignments if item.state is State.MERGED]
    found = []
    for own in merged:
        points = own.submap.points
        away = []
        for other in merged:
            here = other.S_global_map.inverse() @ own.S_global_map
            there = (
                belongs[other.submap.map_id].S_global_map.inverse()
                @ belongs[own.submap.map_id].S_global_map
            )
            distances = np.linalg.norm(here.apply(points) - there.apply(points), axis=1)
            away.append(np.median(distances) / scene_radius(there.apply(points)))
        if np.median(away) > OFF:
            found.append(own.submap.map_id)
    return found


def cases(share: float, fleets: Sequence[Sequence[SubMap]]) -> Iterator[Case]:
    """Each sub-map of each fleet, with this share of wrong ids."""
    for seed, submaps in enumerate(fleets):
        right = fuse(submaps)
        for k, submap in enumerate(submaps):
            wrong = renumbered(submap, share, np.random.default_rng([seed, k]))
            several = [*submaps[:k], wrong, *submaps[k + 1 :]]
            begin = time.process_time()
            fusion = fuse(several)
            yield judged(fusion, right, submap.map_id, time.process_time() - begin)


def row(share: float, found: Sequence[Case]) -> str:
    """One row of the table."""
    seconds = [case.seconds for case in found]
    elsewhere = sum(case.misplaced > 0 for case in found)
    in_place = sum(case.merged and not case.misplaced for case in found)
    return (
        f'| {share:.0%} | {len(found)} | {in_place} | {elsewhere} | '
        f'{sum(not case.merged for case in found)} | {sum(case.innocent > 0 for case in found)} | '
        f'{np.mean(seconds):.2f} | {max(seconds):.2f} |'
    )


def rows(shares: Sequence[float], fleets: int, drones: int) -> Iterator[str]:
    """Every row of the table."""
    submaps = [
        simulate_fleet(FleetConfig(drones=drones), seed=seed).submaps() for seed in range(fleets)
    ]
    for share in shares:
        yield row(share, list(cases(share, submaps)))


def main(argv: list[str] | None = None) -> int:
    """Print the table, and write it into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--fleets', type=int, default=FLEETS)
    parser.add_argument('--drones', type=int, default=DRONES, help='of each fleet')
    parser.add_argument('--shares', type=float, nargs='+', default=SHARES)
    parser.add_argument('--markdown', type=Path, help='document whose table is replaced')
    args = parser.parse_args(argv)
    head = [HEAD, '|---' * (HEAD.count(' |')) + '|']
    return published(
        lambda: itertools.chain(head, rows(args.shares, args.fleets, args.drones)),
        args.markdown,
        'wrong ids',
    )


if __name__ == '__main__':
    sys.exit(main())
