# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What good tracks and uncertain lenses do to the merge test of real, unchanged maps.

    python benchmarks/variance_factors.py ../shared/data --draws 2
    python benchmarks/variance_factors.py ../shared/data --draws 0 --landmarks 300

For every set the variance factor of the merge (1 = the test may be believed) and the median
distance to the gold bundle, in scene radii, with true ids and random common landmarks. Gold has
fixed intrinsics and all links, bad ones included; with --rounds the merge is also compared with
the full bundle of its own links and lenses, which rounds of re-linearisation reach.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from data_sets import data_sets
from documents import published
from real_data import error_ratio, procrustes_and_averaging

from mapmerge_ros.bundle import Bundle, MapName, compress, with_lens_prior
from mapmerge_ros.bundle.quality import TrackQuality
from mapmerge_ros.bundle.selection import matched
from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.fusion import Fusion, fuse
from mapmerge_ros.fusion.refine import Robot, refine
from mapmerge_ros.io import load_colmap

VARIANTS = (
    ('before', False, False),
    ('good tracks', True, False),
    ('lens', False, True),
    ('both', True, True),
)


@dataclass(frozen=True)
class Row:
    """One set, one way to compress, mean over the draws."""

    name: str
    variant: str
    landmarks: float
    merged: str
    variance_factor: float
    to_gold: float
    procrustes_to_gold: float
    to_own_full: float
    """nan = not asked for"""


def draw(common: tuple[np.ndarray, ...], cap: int, seed: int) -> list[np.ndarray]:
    """At most `cap` ids of each map, at random, every one in at least two maps."""
    ids, counts = np.unique(np.concatenate(common), return_counts=True)
    owners = np.array([np.isin(ids, own) for own in common])
    room, taken = np.full(len(common), cap), np.zeros_like(owners)
    for slot in np.random.default_rng(seed).permutation(np.flatnonzero(counts > 1)):
        takers = owners[:, slot] & (room > 0)
        if takers.sum() > 1:
            taken[takers, slot] = True
            room[takers] -= 1
    return [ids[row] for row in taken]


def robots_of(bundles: list[Bundle], chosen: list[np.ndarray]) -> list[Robot]:
    """Sessions with the landmarks that they share."""
    return [
        Robot(MapName(f'session_{k}', 'robot', id_space='truth'), bundle, ids)
        for k, (bundle, ids) in enumerate(zip(bundles, chosen, strict=True))
    ]


def common_landmarks(fusion: Fusion) -> tuple[np.ndarray, np.ndarray]:
    """Ids and positions of the landmarks of several maps."""
    landmarks = fusion.components[0].landmarks
    shared = np.bincount(landmarks.member_rows, minlength=len(landmarks.ids)) > 1
    return landmarks.ids[shared], landmarks.points_global[shared]


def distance(fusion: Fusion, reference: tuple[np.ndarray, np.ndarray]) -> float:
    """Median distance to reference ids (ascending) and points, in scene radii."""
    ids, points = common_landmarks(fusion)
    known = np.isin(ids, reference[0])
    return error_ratio(points[known], reference[1][np.searchsorted(reference[0], ids[known])])


def evaluate(folder: Path, cap: int, draws: int, prior_px: float, rounds: int) -> Iterator[Row]:
    """All variants of one set."""
    bundles = [load_colmap(path) for path in sorted(folder.glob('session_*'))]
    gold_bundle = load_colmap(folder / 'gold')
    order = np.argsort(gold_bundle.point_ids)
    gold = gold_bundle.point_ids[order], gold_bundle.points[order]
    for label, tracks, lens in VARIANTS:
        quality = TrackQuality() if tracks else None
        common, ranked = matched(bundles, None, quality), matched(bundles, cap, quality)
        seen = [with_lens_prior(b, prior_px) if lens else b for b in bundles]
        numbers = []
        for seed in range(max(draws, 1)):
            robots = robots_of(seen, draw(common, cap, seed) if draws else ranked)
            submaps = [
                compress(robot.bundle, robot.name, robot.landmark_ids, catalogue=False)
                for robot in robots
            ]
            fusion = fuse(submaps)
            ids = np.intersect1d(common_landmarks(fusion)[0], gold[0])
            baseline = procrustes_and_averaging(submaps, ids)
            numbers.append(
                (
                    len(ids),
                    fusion.components[0].verdict.variance_factor,
                    distance(fusion, gold),
                    error_ratio(baseline, gold[1][np.searchsorted(gold[0], ids)]),
                    to_own_full(robots, fusion, rounds) if rounds else np.nan,
                )
            )
        count, factor, to_gold, baseline_to_gold, to_full = np.mean(numbers, axis=0)
        merged = f'{len(fusion.components[0].map_ids)} of {len(bundles)}'
        yield Row(folder.name, label, count, merged, factor, to_gold, baseline_to_gold, to_full)


def to_own_full(robots: list[Robot], fusion: Fusion, rounds: int) -> float:
    """Distance of a single merge to the full bundle of the same links and lenses."""
    _, history = refine(robots, rounds)
    return distance(fusion, common_landmarks(history[-1].fusion))


def main(argv: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', type=Path, help='folder with one folder per data set')
    parser.add_argument('--sets', nargs='*', help='names of the folders (default: all)')
    parser.add_argument('--landmarks', type=int, default=220, help='of a map, at most')
    parser.add_argument(
        '--draws', type=int, default=2, help='of random landmarks; 0 = those that compress takes'
    )
    parser.add_argument('--lens-prior', type=float, default=0.12)
    parser.add_argument('--rounds', type=int, default=0)
    args = parser.parse_args(argv)
    return published(lambda: lines(args), None, '')


def lines(args: argparse.Namespace) -> Iterator[str]:
    """Lines of the table."""
    folders = [x for x in data_sets(args.data) if not args.sets or x.name in args.sets]
    if not folders:
        raise MapMergeError(f'{args.data}: none of the data sets {", ".join(args.sets)}')
    yield (
        '| set | compressed | maps merged | landmarks | ã/(dof σ²) | to gold | '
        'Procrustes and averaging to gold | to the full bundle of the same links and lenses |'
    )
    yield '|---' * 8 + '|'
    for folder in folders:
        for row in evaluate(folder, args.landmarks, args.draws, args.lens_prior, args.rounds):
            yield (
                f'| {row.name} | {row.variant} | {row.merged} | {row.landmarks:.0f} | '
                f'{row.variance_factor:.2f} | {row.to_gold:.1e} | '
                f'{row.procrustes_to_gold:.1e} | {row.to_own_full:.1e} |'
            )


if __name__ == '__main__':
    sys.exit(main())
