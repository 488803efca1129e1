# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What a choice of landmarks is worth, beside landmarks drawn by lot.

    python benchmarks/landmark_choice.py ../shared/data --markdown docs/throughput.md

Judged are the merged landmarks, which is what goes out; the frames of the robots, which is all
that a choice can do for them; and everything that the robots have reconstructed, after each has
taken the merged landmarks back (eq. 4): all points and all cameras, compared with the gold bundle
of a real set, or with the truth of a simulated one (`choice_errors`). The lot draws among the
landmarks that two robots have in common, each for all robots that have it, within the same budget.
The last column says how many lots bring all robots together if each robot draws among its own
landmarks, knowing nothing of the others. Ids are known.

Numbers are the error of the choice over the median error of the lots. What the merge of all common
landmarks reaches (at most 400 of a map) is given for the frames: no choice can do much better.
Simulated fleets are pooled over their seeds, as one choice is one sample of their noise.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from choice_errors import COLUMNS, errors, merge
from choice_robots import FLEETS, Robots, real_robots, simulated_robots
from data_sets import data_sets
from documents import published

from mapmerge_ros.arrays import Floats, Ids
from mapmerge_ros.bundle import Bundle
from mapmerge_ros.fusion.offline import choose_for_bundles

BUDGETS = (24, 50, 100)

MOST = 400
"""Landmarks of a map that stand for all common ones where those are thousands."""

FRAMES = COLUMNS.index('frames, RMS')

LAST_COLUMNS = ('all common, frames', 'lots joined', 'own lots joined')

HEAD = [
    f'| robots | budget | {" | ".join((*COLUMNS, *LAST_COLUMNS))} |',
    '|---' * (len(COLUMNS) + len(LAST_COLUMNS) + 2) + '|',
]


@dataclass(frozen=True, eq=False)
class Compared:
    """Errors (7,) of one choice, of the median lot, and of the merge of everything."""

    chosen: Floats
    lot: Floats
    everything: Floats
    joined: int
    """Lots that joined all robots"""
    alone_joined: int
    """Lots of each robot for itself that did"""


def by_lot(bundles: Sequence[Bundle], budget: int, rng: np.random.Generator) -> list[Ids]:
    """Common landmarks in random order, each for all who have it and have room."""
    ids = np.unique(np.concatenate([bundle.point_ids for bundle in bundles]))
    owners = np.array([np.isin(ids, bundle.point_ids) for bundle in bundles])
    room, taken = np.full(len(bundles), budget), np.zeros_like(owners)
    for track in rng.permutation(np.flatnonzero(owners.sum(axis=0) > 1)):
        takers = owners[:, track] & (room > 0)
        if takers.sum() > 1:
            taken[takers, track] = True
            room[takers] -= 1
    return [ids[row] for row in taken]


def by_own_lot(bundles: Sequence[Bundle], budget: int, rng: np.random.Generator) -> list[Ids]:
    """Landmarks in random order, of each robot for itself."""
    return [
        np.sort(rng.choice(bundle.point_ids, min(budget, len(bundle.point_ids)), replace=False))
        for bundle in bundles
    ]


def error_of(robots: Robots, chosen: Sequence[Ids]) -> Floats | None:
    """Errors (7,) of a choice; None where it does not bring all robots together."""
    both = merge(robots, chosen)
    return None if both is None else errors(robots, *both)


def compare(robots: Robots, budgets: Sequence[int], draws: int) -> list[Compared]:
    """Compare the choice with the lot, for every budget."""
    nothing = np.full(len(COLUMNS), np.nan)
    everything = error_of(robots, by_lot(robots.bundles, MOST, np.random.default_rng(0)))
    compared = []
    for budget in budgets:
        chosen = error_of(
            robots, choose_for_bundles(robots.bundles, robots.names, budget, robots.quality)
        )
        drawn, alone = (
            [
                error_of(robots, lot(robots.bundles, budget, rng))
                for rng in generators(budget, draws)
            ]
            for lot in (by_lot, by_own_lot)
        )
        joined = [each for each in drawn if each is not None]
        compared.append(
            Compared(
                nothing if chosen is None else chosen,
                np.median(joined, axis=0) if joined else nothing,
                nothing if everything is None else everything,
                len(joined),
                sum(each is not None for each in alone),
            )
        )
    return compared


def generators(budget: int, draws: int) -> list[np.random.Generator]:
    """Random numbers of each lot."""
    return [np.random.default_rng([budget, draw]) for draw in range(draws)]


def pooled(one_budget: Sequence[Compared]) -> tuple[Floats, float]:
    """Ratios (7,) of the choice to the lot, and of everything's frames, over all seeds."""
    sizes = [
        np.sqrt(np.mean(np.square([getattr(each, name) for each in one_budget]), axis=0))
        for name in ('chosen', 'everything', 'lot')
    ]
    return sizes[0] / sizes[2], float(sizes[1][FRAMES] / sizes[2][FRAMES])


def rows(groups: Iterator[tuple[str, list[Robots]]], draws: int) -> Iterator[str]:
    """Lines of the table."""
    for name, group in groups:
        compared = [compare(robots, BUDGETS, draws) for robots in group]
        for at, budget in enumerate(BUDGETS):
            one_budget = [each[at] for each in compared]
            ratios, bound = pooled(one_budget)
            cells = ' | '.join(f'{ratio:.2f}' for ratio in (*ratios, bound))
            joined, alone = (
                f'{sum(getattr(each, which) for each in one_budget)} of {draws * len(group)}'
                for which in ('joined', 'alone_joined')
            )
            yield f'| {name} | {budget} | {cells} | {joined} | {alone} |'


def every(data: Path | None, seeds: int) -> Iterator[tuple[str, list[Robots]]]:
    """Real sets first, one after the other."""
    for folder in data_sets(data) if data else ():
        yield folder.name, [real_robots(folder)]
    for name, config in FLEETS.items():
        fleets = [simulated_robots(name, config, seed) for seed in range(seeds)]
        yield f'{name}, {seeds} fleets', fleets


def main(argv: list[str] | None = None) -> int:
    """Print the table, and write it into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        'data', type=Path, nargs='?', help='folder with one folder per data set (default: none)'
    )
    parser.add_argument('--draws', type=int, default=25)
    parser.add_argument('--seeds', type=int, default=4, help='of each simulated fleet')
    parser.add_argument('--markdown', type=Path, help='document whose table is replaced')
    args = parser.parse_args(argv)
    groups = every(args.data, args.seeds)
    return published(
        lambda: itertools.chain(HEAD, rows(groups, args.draws)), args.markdown, 'choice'
    )


if __name__ == '__main__':
    sys.exit(main())
