# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
Two real maps with few landmarks in common: whether they are believed, and one that is wrong.

    python benchmarks/pairs_of_maps.py ../shared/data --markdown docs/statistics.md

Every pair of sessions of each set, in draws of at most 100 common landmarks of all of them.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from data_sets import data_sets
from documents import published
from honest_tests import DAMAGES, counted, draw, load

from mapmerge_ros.fusion import Verdict, fuse
from mapmerge_ros.submap import SubMap

HEAD = '| what is wrong | pairs | kept apart | accepted by the textbook | accepted |'

LANDMARKS, SEEDS = 100, (0, 1, 2)
LEAST, MOST = 4, 50
"""Landmarks in common: fewer are no link, more carry a model by themselves."""


def pairs(folder: Path, seeds: tuple[int, ...]) -> Iterator[list[SubMap]]:
    """Two sub-maps each, of all sessions of one place."""
    bundles, shared = load(folder, all_tracks=False)
    for seed in seeds:
        submaps = draw(bundles, shared, seed, LANDMARKS)
        for a, b in itertools.combinations(submaps, 2):
            common = np.intersect1d(a.compressed_ids, b.compressed_ids)
            if LEAST <= len(common) < MOST:
                yield [a, b]


def row(what: str, verdicts: list[Verdict]) -> str:
    """One row of the table."""
    return f'| {what} | {counted(verdicts)} |'


def rows(folders: list[Path], seeds: tuple[int, ...]) -> Iterator[str]:
    """Every row of the table."""
    every = [(folder.name, pair) for folder in folders for pair in pairs(folder, seeds)]
    for name, own in itertools.groupby(every, lambda item: item[0]):
        yield row(f'nothing, {name}', [judged(pair) for _, pair in own])
    for what, damage, amount in DAMAGES:
        wrong = [damage(pair, amount, np.random.default_rng(0)) for _, pair in every]
        yield row(what, [judged(pair) for pair in wrong])


def judged(pair: list[SubMap]) -> Verdict:
    """Verdict on the merge of two, or on one of them alone if they are not joined."""
    return fuse(pair).verdict


def main(argv: list[str] | None = None) -> int:
    """Print the table, and write it into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('data', type=Path, help='folder with one folder per data set')
    parser.add_argument('--markdown', type=Path, help='document whose table is replaced')
    args = parser.parse_args(argv)
    head = [HEAD, '|---' * (HEAD.count(' |')) + '|']
    return published(
        lambda: itertools.chain(head, rows(data_sets(args.data), SEEDS)),
        args.markdown,
        'pairs of maps',
    )


if __name__ == '__main__':
    sys.exit(main())
