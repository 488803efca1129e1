# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks of a whole set are one: how many links, how right, how long it takes."""

from __future__ import annotations

import time
from itertools import combinations
from pathlib import Path

import numpy as np
from scoring import Links, Scorer

from mapmerge_ros.association import Correspondences, Decision, associate
from mapmerge_ros.submap import SubMap

ASKED = {
    'euroc_v101_maplab': (0.85, 0.97, 0.80),
    'boruszyn_kite': (0.97, 0.999, 0.93),
}
"""Precision by id and by joint triangulation, recall; ELSEWHERE where not named."""
ELSEWHERE = (0.97, 0.999, 0.95)
REPEATS = 3
"""The fastest counts: others may be at work on the machine."""


def links(sets: dict[str, list[SubMap]], data: Path) -> str:
    """Markdown: one line per set."""
    lines = [
        '| set | maps in one component | pairs joined directly | links | precision by id | '
        'by joint triangulation | recall | asked | processor seconds |',
        '|---' * 9 + '|',
    ]
    for name, submaps in sets.items():
        runs = [timed(submaps) for _ in range(REPEATS)]
        found, seconds = min(runs, key=lambda run: run[1])
        score = Scorer(data / name).score(links_of(found))
        joined = sum(match.decision is Decision.JOINED for match in found.matches.values())
        asked = ' / '.join(f'{value:g}' for value in ASKED.get(name, ELSEWHERE))
        lines.append(
            f'| {name} | {largest_component(found)} of {len(submaps)} | '
            f'{joined} of {len(found.matches)} | {score.links} | {score.precision_by_id:.4f} | '
            f'{score.precision_by_triangulation:.4f} | {score.recall:.4f} | {asked} | '
            f'{seconds:.2f} |'
        )
    return '\n'.join(lines)


def timed(submaps: list[SubMap]) -> tuple[Correspondences, float]:
    """Associate from scratch; processor seconds."""
    begin = time.process_time()
    found = associate(submaps)
    return found, time.process_time() - begin


def links_of(found: Correspondences) -> list[Links]:
    """Landmarks of every pair of maps that are in one track."""
    result = []
    for a, b in combinations(range(len(found.tracks)), 2):
        _, rows_a, rows_b = np.intersect1d(
            found.tracks[a], found.tracks[b], assume_unique=True, return_indices=True
        )
        result.append(Links(a, b, rows_a, rows_b))
    return result


def largest_component(found: Correspondences) -> int:
    """Sub-maps that common landmarks hold together, directly or through others."""
    groups = [{k} for k in range(len(found.tracks))]
    for a, b in combinations(range(len(found.tracks)), 2):
        if groups[a] is not groups[b] and found.common(a, b):
            groups[a] |= groups[b]
            for k in groups[b]:
                groups[k] = groups[a]
    return max(map(len, groups))
