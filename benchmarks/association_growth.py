# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How the cost of a whole association grows with the number of sub-maps."""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.association import Correspondences, Decision, Memory, associate
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.simulation import announcement, yard_scene
from mapmerge_ros.submap import SubMap

COUNTS = (8, 16, 32, 64)
CELL = np.array([31.0, 23.0])
"""Of the grid that each drone has one cell of [m]."""
MARGIN = 4.0
"""That it sees of the neighbours' cells [m]."""
LANDMARKS = 1000
"""of a map"""
REPEATS = 2
"""The fastest counts: others may be at work on the machine."""


@dataclass(frozen=True)
class Run:
    """One association from scratch and the same with one map more; processor seconds."""

    found: Correspondences
    seconds: float
    one_more: float
    """The last map comes when all others are known"""


def growth() -> str:
    """Markdown table."""
    lines = [
        '| maps | pairs | overlapping | matched | overlapping, not matched | joined | '
        'joined wrongly | links | right | all [s] | exponent since 8 | one map more [s] |',
        '|---' * 12 + '|',
    ]
    first = 0.0
    for count in COUNTS:
        submaps, seen = catalogues(count)
        runs = [timed(submaps) for _ in range(REPEATS)]
        seconds = min(run.seconds for run in runs)
        first = first or seconds
        exponent = np.log(seconds / first) / np.log(count / COUNTS[0]) if count > COUNTS[0] else 0
        lines.append(
            f'| {count} {_pair_cells(runs[0].found, seen)} {_link_cells(runs[0].found, seen)} '
            f'| {seconds:.2f} | {f"{exponent:.2f}" if exponent else "–"} | '
            f'{min(run.one_more for run in runs):.2f} |'
        )
    return '\n'.join(lines)


def timed(submaps: list[SubMap]) -> Run:
    """Associate all, and all but the last before all."""
    begin = time.process_time()
    found = associate(submaps)
    seconds = time.process_time() - begin
    memory = Memory()
    associate(submaps[:-1], memory=memory)
    begin = time.process_time()
    associate(submaps, memory=memory)
    return Run(found, seconds, time.process_time() - begin)


def _pair_cells(found: Correspondences, seen: list[Ints]) -> str:
    pairs = list(combinations(range(len(seen)), 2))
    common = {(i, j): len(np.intersect1d(seen[i], seen[j])) for i, j in pairs}
    overlapping = {pair for pair, shared in common.items() if shared >= 10}
    joined = {p for p, match in found.matches.items() if match.decision is Decision.JOINED}
    return (
        f'| {len(common)} | {len(overlapping)} | {len(found.matches)} | '
        f'{len(overlapping - set(found.matches))} | {len(joined)} | '
        f'{sum(common[pair] == 0 for pair in joined)}'
    )


def _link_cells(found: Correspondences, seen: list[Ints]) -> str:
    total, right = 0, 0
    for a, b in combinations(range(len(seen)), 2):
        _, rows_a, rows_b = np.intersect1d(
            found.tracks[a], found.tracks[b], assume_unique=True, return_indices=True
        )
        total += len(rows_a)
        right += int((seen[a][rows_a] == seen[b][rows_b]).sum())
    return f'| {total} | {right / total:.4f}'


def catalogues(count: int, seed: int = 0) -> tuple[list[SubMap], list[Ints]]:
    """Catalogues of drones over one yard, and which landmarks of the scene each has."""
    rng = np.random.default_rng(seed)
    columns = int(np.ceil(np.sqrt(count)))
    extent = CELL * (columns + 1)
    density = LANDMARKS / np.prod(CELL + 2 * MARGIN)
    scene = yard_scene(rng, int(density * np.prod(extent)), tuple(extent), houses=2 * count)
    submaps, seen = [], []
    for k in range(count):
        centre = (np.array([k % columns, k // columns]) - 0.5 * (columns - 1)) * CELL
        inside = (np.abs(scene.points[:, :2] - centre) < 0.5 * CELL + MARGIN).all(axis=1)
        rows = rng.permutation(np.flatnonzero(inside))
        S_map_world = Similarity.exp(rng.normal(size=7))
        points = S_map_world.apply(scene.points[rows] + 0.03 * rng.normal(size=(len(rows), 3)))
        flips = np.packbits(rng.random((len(rows), 32, 8)) < 0.08, axis=-1)[..., 0]
        submaps.append(announcement(f'drone{k:02d}', points, scene.descriptors[rows] ^ flips))
        seen.append(rows)
    return submaps, seen
