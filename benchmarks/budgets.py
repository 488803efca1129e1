# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Whether what is said of a merge depends on how many landmarks were sent, and which.

    python benchmarks/budgets.py ../shared/data --markdown docs/statistics.md

All sessions of each set, all tracks, lenses taken as exact: with the landmarks that
`mapmerge compress --landmarks` takes, with the longest tracks, and with random draws; then one
session of each draw is damaged.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from data_sets import data_sets
from documents import published
from honest_tests import DAMAGES, draw, load
from real_data import compress_sessions

from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.fusion import Fusion, fuse
from mapmerge_ros.fusion.offline import choose_for_bundles
from mapmerge_ros.submap import SubMap

BUDGETS = (24, 30, 40, 50, 60, 75, 100, 125, 150, 200, 250, 300)
"""Landmarks of a sub-map, chosen"""

DRAWN, SEEDS = (30, 40, 50, 70, 100, 140, 200, 260), (0, 1)
"""Landmarks of all sub-maps together, by lot"""

DAMAGED_FROM = 50
"""Landmarks of a draw from which one sub-map is damaged as well."""

HEAD = (
    '| landmarks | what is wrong with one | merges | kept apart | accepted, it included | '
    'it named | another named | not said: may be turned | moved objects |'
)


@dataclass(frozen=True)
class Case:
    """One set with some of its landmarks."""

    choice: str
    what: str
    submaps: Sequence[SubMap]

    @property
    def row(self) -> tuple[str, str]:
        """Row of the table in which it counts."""
        return self.choice, self.what


def cases(
    folder: Path, budgets: Iterable[int], drawn: Iterable[int], seeds: Iterable[int]
) -> Iterator[Case]:
    """Merges of one set in which nothing is wrong, and with one sub-map damaged."""
    bundles, shared = load(folder, all_tracks=True)
    names = [MapName(f'session_{k}', 'robot', id_space='truth') for k in range(len(bundles))]
    for budget in budgets:
        chosen = choose_for_bundles(bundles, names, budget, catalogue=False)
        submaps = [
            compress(bundle, name, ids, catalogue=False)
            for bundle, name, ids in zip(bundles, names, chosen, strict=True)
        ]
        yield Case('chosen, 24 to 300 a map', 'nothing', submaps)
        yield Case('longest tracks, 24 to 300', 'nothing', compress_sessions(folder, budget)[0])
    for landmarks, seed in itertools.product(drawn, seeds):
        submaps = draw(bundles, shared, seed, landmarks)
        few = landmarks < DAMAGED_FROM
        choice = 'by lot, 30 or 40' if few else 'by lot, 50 to 260'
        yield Case(choice, 'nothing', submaps)
        for what, damage, amount in () if few else DAMAGES:
            yield Case(choice, what, damage(submaps, amount, np.random.default_rng(0)))


@dataclass(frozen=True)
class Said:
    """What a fusion says, in short."""

    merged: bool
    accepted: bool
    may_be_turned: bool
    moved: bool
    first: str
    """The sub-map that is damaged, if any"""
    included: bool
    """Whether that one is in the map that comes out"""
    named: frozenset[str]

    @classmethod
    def by(cls, fusion: Fusion) -> Said:
        """What it says."""
        first = fusion.alignments[0].submap.map_id
        return cls(
            merged=fusion.verdict.dof > 0,
            accepted=fusion.verdict.accepted,
            may_be_turned='a wrong place is not told' in fusion.verdict.reason,
            moved=fusion.verdict.moved > 0,
            first=first,
            included=bool(fusion.components) and first in fusion.components[0].map_ids,
            named=frozenset(item.submap.map_id for item in fusion.quarantined),
        )


def counted(what: str, every: Sequence[Said]) -> str:
    """Numbers of a row."""
    merged = [each for each in every if each.merged]
    if what == 'nothing':
        named, others = '–', sum(bool(each.named) for each in merged)
    else:
        named = str(sum(each.first in each.named for each in merged))
        others = sum(bool(each.named - {each.first}) for each in merged)
    accepted = sum(each.accepted and each.included for each in merged)
    turned = sum(each.may_be_turned for each in merged)
    moved = sum(each.moved for each in merged)
    return (
        f'{len(every)} | {len(every) - len(merged)} | {accepted} | {named} | {others} | '
        f'{turned} | {moved}'
    )


def rows(
    folders: Sequence[Path],
    budgets: Sequence[int] = BUDGETS,
    drawn: Sequence[int] = DRAWN,
    seeds: Sequence[int] = SEEDS,
) -> Iterator[str]:
    """Every row of the table."""
    found: dict[tuple[str, str], list[Said]] = {}
    for folder in folders:
        for case in cases(folder, budgets, drawn, seeds):
            found.setdefault(case.row, []).append(Said.by(fuse(case.submaps)))
    for (choice, what), said in found.items():
        yield f'| {choice} | {what} | {counted(what, said)} |'


def main(argv: list[str] | None = None) -> int:
    """Print the table, and write it into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', type=Path, help='folder with one folder per data set')
    parser.add_argument('--markdown', type=Path, help='document whose table is replaced')
    args = parser.parse_args(argv)
    head = [HEAD, '|---' * (HEAD.count(' |')) + '|']
    return published(
        lambda: itertools.chain(head, rows(data_sets(args.data))), args.markdown, 'budgets'
    )


if __name__ == '__main__':
    sys.exit(main())
