# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pairs of sub-maps that have nothing in common: none may be joined."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from mapmerge_ros.arrays import Ints, Mask
from mapmerge_ros.association import AssociationConfig, Decision, PairMatch, match_pair
from mapmerge_ros.bundle import compress
from mapmerge_ros.simulation import StreetConfig, simulate_street
from mapmerge_ros.submap import SubMap

CONFIG = AssociationConfig()
ROUNDS = 20
"""Halves and shuffles of every sub-map."""

STREETS = {
    'street': StreetConfig(),
    'street, windows that differ more': StreetConfig(own_flip_ratio=0.12, place_flip_ratio=0.03),
    'street, façades that differ less': StreetConfig(own_flip_ratio=0.06, place_flip_ratio=0.04),
    'street, façades alike': StreetConfig(own_flip_ratio=0.05, place_flip_ratio=0.05),
}
LIMIT = StreetConfig(own_flip_ratio=0.04, place_flip_ratio=0.06)
"""A façade that is there twice, element by element: beyond what two maps can tell."""
SEEDS = (1, 2)

Pairs = Iterator[tuple[SubMap, SubMap]]


def no_false_join(sets: dict[str, list[SubMap]]) -> str:
    """Markdown: how many of the pairs are joined, and the evidence of the worst."""
    lines = [
        '| pairs without anything in common | number | joined | undecided | least log NFA, '
        'its inliers / candidates | least clear ratio at log NFA ≤ -5 |',
        '|---' * 6 + '|',
    ]
    kinds: dict[str, Callable[[], Pairs]] = {
        'maps of different places': lambda: _cross(sets),
        'disjoint halves of a map': lambda: _halves(sets),
        'descriptors shuffled among landmarks': lambda: _shuffled(sets),
    }
    lines += [
        _line(name, [match_pair(*own, CONFIG) for own in of()]) for name, of in kinds.items()
    ]
    beside = ['| overlapping pairs of the same streets | number | joined |', '|---|---|---|']
    for name, street in {**STREETS, 'a façade twice (not asked)': LIMIT}.items():
        alias, true = _street(street)
        lines.append(_line(name, alias))
        joined = sum(match.decision is Decision.JOINED for match in true)
        beside.append(f'| {name} | {len(true)} | {joined} |')
    return '\n'.join([*lines, '', *beside])


def _line(name: str, matches: list[PairMatch]) -> str:
    count = {kind: sum(m.decision is kind for m in matches) for kind in Decision}
    worst = min((m.evidence for m in matches), key=lambda e: e.log_nfa)
    clear = [m.evidence.clear_ratio for m in matches if m.evidence.log_nfa <= CONFIG.max_log_nfa]
    return (
        f'| {name} | {len(matches)} | {count[Decision.JOINED]} | {count[Decision.UNDECIDED]} | '
        f'{worst.log_nfa:.1f}, {worst.inliers} / {worst.candidates} | '
        f'{f"{min(clear):.2f}" if clear else "–"} |'
    )


def _cross(sets: dict[str, list[SubMap]]) -> Pairs:
    for one, other in combinations(sets.values(), 2):
        for a in one:
            for b in other:
                if a.descriptors.type is b.descriptors.type:
                    yield a, b


def _halves(sets: dict[str, list[SubMap]]) -> Pairs:
    """Both sides of a random plane, a gap of one landmark in fifty or a fifth between them."""
    rng = np.random.default_rng(2)
    for submap in (own for submaps in sets.values() for own in submaps):
        for turn in range(ROUNDS):
            along = submap.points @ rng.normal(size=3)
            gap = (0.01, 0.1)[turn % 2]
            middle = rng.uniform(0.35, 0.65)
            low, high = np.quantile(along, [middle - gap, middle + gap])
            yield part(submap, along < low, 'low'), part(submap, along > high, 'high')


def _shuffled(sets: dict[str, list[SubMap]]) -> Pairs:
    rng = np.random.default_rng(3)
    for submaps in sets.values():
        for k, submap in enumerate(submaps):
            for turn in range(ROUNDS):
                other = submaps[(k + 1 + turn % (len(submaps) - 1)) % len(submaps)]
                mixed = other.descriptors[rng.permutation(len(other.points))]
                yield submap, replace(other, descriptors=mixed)


def _street(config: StreetConfig) -> tuple[list[PairMatch], list[PairMatch]]:
    """Matches of drones before different façades, and before the same one."""
    apart, same = [], []
    for seed in SEEDS:
        street = simulate_street(config, seed)
        submaps = [
            compress(bundle, name, bundle.point_ids[:0])
            for bundle, name in zip(street.bundles, street.names, strict=True)
        ]
        for i, j in combinations(range(len(submaps)), 2):
            match = match_pair(submaps[i], submaps[j], CONFIG)
            common = np.intersect1d(street.landmark_ids[i], street.landmark_ids[j])
            if len(common) == 0:
                apart.append(match)
            elif street.facades[i] == street.facades[j]:
                same.append(match)
    return apart, same


def part(submap: SubMap, rows: Mask | Ints, name: str) -> SubMap:
    """Some landmarks of a bare announcement, as a map of their own."""
    return replace(
        submap,
        map_id=f'{submap.map_id}/{name}',
        landmark_ids=submap.landmark_ids[rows],
        points=submap.points[rows],
        covariances=None if submap.covariances is None else submap.covariances[rows],
        descriptors=submap.descriptors[rows],
    )
