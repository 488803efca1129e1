# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What the tests say of real sub-maps where nothing moved, and of merges that are wrong.

    python benchmarks/honest_tests.py ../shared/data --markdown docs/statistics_tables.md

Every session is compressed by itself to a random draw of good tracks that it shares with another
one, with its lens known to 0.12 px. The ids of the data are the matches.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from data_sets import data_sets
from documents import published

from mapmerge_ros.bundle import Bundle, MapName, compress, with_lens_prior
from mapmerge_ros.bundle.quality import TrackQuality
from mapmerge_ros.bundle.selection import matched
from mapmerge_ros.experiments.room import simulate_room
from mapmerge_ros.fusion import Fusion, FusionConfig, Verdict, fuse
from mapmerge_ros.io import load_colmap
from mapmerge_ros.simulation import FleetConfig, simulate_fleet
from mapmerge_ros.submap import SubMap

LANDMARKS, SEEDS = 220, (0, 1, 2)
LARGEST_SHARE = 0.8
"""Of the common landmarks in one draw, or all draws are the same."""

LENS_PRIOR_PX = 0.12
FIRST_PRIVATE_ID = 100_000_000
"""Ids from here on are private: equal ones are different points."""

CHOSEN_ON, ROOMS = ('euroc_v101_maplab', 'caliterra_drone'), 200

UNCHANGED_HEAD = (
    '| set | draw | landmarks | ã/(dof σ²) | φ | τ / radius | ω / radius | ν | p < 0.01 | '
    'textbook | aside | p of the whole | accepted | test, CPU s |'
)
WRONG_HEAD = (
    '| what is wrong | merges | kept apart | accepted by the textbook | accepted | first reason |'
)


def load(folder: Path, *, all_tracks: bool) -> tuple[list[Bundle], list[np.ndarray]]:
    """Sessions of one place and the ids that each may share."""
    bundles = [load_colmap(path) for path in sorted(folder.glob('session_*'))]
    shared = matched(bundles, None, None if all_tracks else TrackQuality())
    prior = 0.0 if all_tracks else LENS_PRIOR_PX
    return [with_lens_prior(bundle, prior) for bundle in bundles], list(shared)


def draw(
    bundles: Sequence[Bundle],
    shared: Sequence[np.ndarray],
    seed: int,
    landmarks: int = LANDMARKS,
) -> list[SubMap]:
    """Compress each session to what it has of a random draw of common landmarks."""
    ids, counts = np.unique(np.concatenate(shared), return_counts=True)
    ids = ids[(counts > 1) & (ids < FIRST_PRIVATE_ID)]
    count = min(landmarks, int(LARGEST_SHARE * len(ids)))
    chosen = np.random.default_rng(seed).choice(ids, count, replace=False)
    return [
        compress(
            bundle,
            MapName(f'session_{k}', 'robot', id_space='truth'),
            np.intersect1d(own, chosen),
            catalogue=False,
        )
        for k, (bundle, own) in enumerate(zip(bundles, shared, strict=True))
    ]


def unchanged_row(name: str, seed: int, submaps: list[SubMap]) -> str:
    """One merge in which nothing moved."""
    begin = time.process_time()
    fusion = fuse(submaps)
    seconds = time.process_time() - begin
    seconds *= fusion.timing.test_s / fusion.timing.total_s
    component = fusion.components[0]
    verdict, found = component.verdict, component.examination
    p_values = found.tests.p_value[found.tests.distinct]
    plain = found.textbook_tests
    before = np.mean(plain.p_value[plain.distinct] < 0.01)
    errors = verdict.errors
    model = (
        f'{errors.phi:.2f} | {errors.tau_ratio:.1e} | {errors.omega_ratio:.1e} | '
        f'{errors.tail_freedom:.1f}'
        if errors
        else '1 | 0 | 0 | ∞'
    )
    mark = '' if name in CHOSEN_ON else ' (check)'
    return (
        f'| {name}{mark} | {seed} | {len(np.unique(found.tests.members.tracks))} | '
        f'{verdict.variance_factor:.2f} | {model} | {np.mean(p_values < 0.01):.1%} | '
        f'{before:.0%} | {verdict.set_aside} | {verdict.p_value:.2f} | '
        f'{"yes" if verdict.accepted else "**no**"} | {seconds:.2f} |'
    )


def mistaken_for_neighbours(
    submaps: list[SubMap], share: float, rng: np.random.Generator
) -> list[SubMap]:
    """Exchange ids of neighbouring landmarks of the first sub-map: wrong links nearby."""
    first = submaps[0]
    others = np.concatenate([submap.compressed_ids for submap in submaps[1:]])
    free = np.isin(first.compressed_ids, others)
    ids, wanted, wrong = first.landmark_ids.copy(), share * free.sum(), 0
    for row in rng.permutation(np.flatnonzero(free)):
        if wrong >= wanted or not free[row]:
            continue
        free[row] = False
        distances = np.linalg.norm(first.compressed_points - first.points[row], axis=1)
        partner = int(np.argmin(np.where(free, distances, np.inf)))
        free[partner] = False
        ids[[row, partner]] = ids[[partner, row]]
        wrong += 2
    return [replace(first, landmark_ids=ids), *submaps[1:]]


def bent(submaps: list[SubMap], share: float, rng: np.random.Generator) -> list[SubMap]:
    """Bend the first sub-map into a bowl, its ends raised by a share of half its length."""
    first = submaps[0]
    centred = first.points - first.points.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    along, size = centred @ axes[0], np.abs(centred @ axes[0]).max()
    points = first.points + np.outer(share * along**2 / size, axes[2])
    return [replace(first, points=points), *submaps[1:]]


def corrupt(submaps: list[SubMap], factor: float, rng: np.random.Generator) -> list[SubMap]:
    """Displace all landmarks of the first sub-map by noise `factor` times what it claims."""
    first = submaps[0]
    sigma = first.sigma or np.sqrt(first.a**2 / first.redundancy)
    white = factor * sigma * rng.normal(size=first.rank)
    moved = np.linalg.lstsq(first.triangle(), white, rcond=None)[0].reshape(-1, 3)
    points = first.points.copy()
    points[: first.compressed_count] += moved
    return [replace(first, points=points), *submaps[1:]]


Damage = Callable[[list[SubMap], float, np.random.Generator], list[SubMap]]

DAMAGES: tuple[tuple[str, Damage, float], ...] = (
    ('20 % wrong links to neighbours', mistaken_for_neighbours, 0.2),
    ('10 % wrong links to neighbours', mistaken_for_neighbours, 0.1),
    ('one map bent by 10 % of half its length', bent, 0.1),
    ('one map bent by 20 %', bent, 0.2),
    ('one map off by 3 times its noise', corrupt, 3.0),
    ('one map off by 6 times its noise', corrupt, 6.0),
)


def wrong_row(what: str, fusions: list[Fusion]) -> str:
    """How merges that are wrong are judged."""
    verdicts = [fusion.verdict for fusion in fusions]
    reasons = [verdict.reason for verdict in verdicts if verdict.reason]
    return f'| {what} | {counted(verdicts)} | {(reasons or ["–"])[0]} |'


def counted(verdicts: Sequence[Verdict]) -> str:
    """All, those in which nothing was merged, and of the others those that are believed."""
    merged = [verdict for verdict in verdicts if verdict.dof > 0]
    textbook = sum(verdict.textbook_p_value >= 0.01 for verdict in merged)
    accepted = sum(verdict.accepted for verdict in merged)
    return f'{len(verdicts)} | {len(verdicts) - len(merged)} | {textbook} | {accepted}'


def damaged_rows(draws: dict[str, list[SubMap]]) -> list[str]:
    """One merge per set and damage."""
    rows = []
    for what, damage, amount in DAMAGES:
        for name, submaps in draws.items():
            wrong = damage(submaps, amount, np.random.default_rng(0))
            rows.append(wrong_row(f'{name}: {what}', [fuse(wrong)]))
    return rows


def room_row() -> str:
    """Narrow rooms, one start only: those whose price is far above noise are in a wrong basin."""
    config = FusionConfig(max_starts=1)
    wrong = []
    for run in range(ROOMS):
        room = simulate_room(np.random.default_rng([5, run]), 0.1)
        fusion = fuse(room.submaps(), config)
        if fusion.verdict.textbook_p_value < 1e-4:
            wrong.append(fusion)
    return wrong_row(f'wrong basin ({ROOMS} narrow rooms, σ known, one start)', wrong)


def fleet_row(moved: int) -> str:
    """Simulated fleets with Gaussian noise, σ estimated."""
    fusions = []
    for seed in range(10):
        fleet = simulate_fleet(FleetConfig(moved=moved), seed)
        fusions.append(fuse([replace(submap, sigma=0.0) for submap in fleet.submaps()]))
    what = f'{moved} objects moved' if moved else 'nothing (Gaussian fleets, to compare)'
    return wrong_row(what, fusions)


def measure(folders: list[Path], *, all_tracks: bool) -> str:
    """Both tables."""
    rows, first = [], {}
    for folder in folders:
        bundles, shared = load(folder, all_tracks=all_tracks)
        for seed in SEEDS:
            submaps = draw(bundles, shared, seed)
            first.setdefault(folder.name, submaps)
            rows.append(unchanged_row(folder.name, seed, submaps))
            print(rows[-1], flush=True)
    wrong = [fleet_row(0), fleet_row(1), room_row(), *damaged_rows(first)]
    return '\n'.join(
        [
            UNCHANGED_HEAD,
            '|---' * UNCHANGED_HEAD.count(' |') + '|',
            *rows,
            '',
            WRONG_HEAD,
            '|---' * WRONG_HEAD.count(' |') + '|',
            *wrong,
        ]
    )


def main(argv: list[str] | None = None) -> int:
    """Print the tables, and write them into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', type=Path, help='folder with one folder per data set')
    parser.add_argument('--markdown', type=Path, help='document whose tables are replaced')
    parser.add_argument(
        '--all-tracks', action='store_true', help='draw from all tracks, lenses taken as exact'
    )
    args = parser.parse_args(argv)
    mark = 'all tracks' if args.all_tracks else 'good tracks'
    return published(
        lambda: [measure(data_sets(args.data), all_tracks=args.all_tracks)], args.markdown, mark
    )


if __name__ == '__main__':
    sys.exit(main())
