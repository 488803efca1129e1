# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every pair of sub-maps of every set: decision, evidence, and how many matches are right."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.association import AssociationConfig, Decision, PairMatch, match_pair
from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.io import load_colmap
from mapmerge_ros.submap import DescriptorType, SubMap

PRIVATE_IDS = 100_000_000
"""From here on an id means nothing outside its session."""

CONFIG = AssociationConfig()


@dataclass(frozen=True)
class Gold:
    """Where the landmarks of the sessions are in the joint reconstruction."""

    points: tuple[Floats, ...]
    """per session, in the rows of its sub-map"""
    tolerance: float
    """Distance up to which two landmarks count as one point"""


def load_sets(data: Path) -> dict[str, list[SubMap]]:
    """Bare announcements of all sessions that have descriptors."""
    sets = {}
    for folder in sorted(path.parent for path in data.glob('*/gold')):
        bundles = [load_colmap(path) for path in sorted(folder.glob('session_*'))]
        if all(bundle.descriptors.type is not DescriptorType.NONE for bundle in bundles):
            sets[folder.name] = [
                compress(bundle, MapName(f'{folder.name}/{k}', f'{k}'), bundle.point_ids[:0])
                for k, bundle in enumerate(bundles)
            ]
    return sets


def load_gold(folder: Path, submaps: list[SubMap]) -> Gold:
    """Read the truth that ids do not tell: the gold position of every landmark."""
    links = np.load(folder / 'gold/links.npz')
    everything = links['points']
    own = []
    for k, submap in enumerate(submaps):
        ids, rows = links[f'session_{k}_point3D_id'], links[f'session_{k}_row']
        order = np.argsort(ids)
        at = order[np.searchsorted(ids[order], submap.landmark_ids.astype(np.int64))]
        own.append(np.where(rows[at][:, None] < 0, np.nan, everything[rows[at]]))
    middle = np.nanmedian(everything, axis=0)
    radius = float(np.nanmedian(np.linalg.norm(everything - middle, axis=1)))
    return Gold(tuple(own), (0.005 if 'euroc' in folder.name else 0.001) * radius)


def right(
    gold: Gold, i: int, j: int, submaps: list[SubMap], rows_i: Ints, rows_j: Ints
) -> tuple[Mask, Mask]:
    """Matches with equal ids, and those with equal ids or gold positions that coincide."""
    ids_i, ids_j = submaps[i].landmark_ids[rows_i], submaps[j].landmark_ids[rows_j]
    same = (ids_i == ids_j) & (ids_i < PRIVATE_IDS)
    apart = np.linalg.norm(gold.points[i][rows_i] - gold.points[j][rows_j], axis=1)
    return same, same | (apart <= gold.tolerance)


def pairs(sets: dict[str, list[SubMap]], data: Path) -> str:
    """Markdown: one line per set, then one line per pair."""
    summary = [
        '| set | maps | pairs joined | inliers | right by id | or by gold position | '
        'weakest join: log NFA, inliers | processor seconds |',
        '|---' * 8 + '|',
    ]
    lines = [
        '| pair | decision | candidates | inliers | right by id | log NFA | inliers / candidates '
        '| agreeing | second | clear | peculiar | reason |',
        '|---' * 12 + '|',
    ]
    for name, submaps in sets.items():
        gold = load_gold(data / name, submaps)
        begin = time.process_time()
        found = [(i, j, match_pair(submaps[i], submaps[j], CONFIG)) for i, j in _all(submaps)]
        seconds = time.process_time() - begin
        scores = [right(gold, i, j, submaps, m.rows_a, m.rows_b) for i, j, m in found]
        joined = [k for k, (_, _, m) in enumerate(found) if m.decision is Decision.JOINED]
        inliers = sum(len(scores[k][0]) for k in joined)
        by_id, by_gold = (sum(int(scores[k][way].sum()) for k in joined) for way in (0, 1))
        evidence = [found[k][2].evidence for k in joined]
        summary.append(
            f'| {name} | {len(submaps)} | {len(joined)} of {len(found)} | {inliers} | '
            f'{by_id / inliers:.3f} | {by_gold / inliers:.3f} | '
            f'{max(e.log_nfa for e in evidence):.1f}, {min(e.inliers for e in evidence)} | '
            f'{seconds:.1f} |'
        )
        lines += [
            f'| {name} {i}–{j} {evidence_cells(m, int(same.sum()))}'
            for (i, j, m), (same, _) in zip(found, scores, strict=True)
        ]
    return '\n'.join([*summary, '', *lines])


def evidence_cells(match: PairMatch, same: int) -> str:
    """Rest of a table line about a pair."""
    e = match.evidence
    return (
        f'| {match.decision.value} | {e.candidates} | {e.inliers} | {same} | {e.log_nfa:.1f} | '
        f'{e.inlier_ratio:.2f} | {e.agreeing_ratio:.2f} | {e.second_ratio:.2f} | '
        f'{e.clear_ratio:.2f} | {e.peculiar_score:.1f} | {match.reason} |'
    )


def _all(submaps: list[SubMap]) -> list[tuple[int, int]]:
    return list(combinations(range(len(submaps)), 2))
