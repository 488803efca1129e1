# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How the cost of finding and matching pairs grows with the number of sub-maps."""

from __future__ import annotations

import time
from itertools import combinations

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.association import AssociationConfig, Decision, PairMatch, match_pair, screen
from mapmerge_ros.geometry import Gauge, Similarity
from mapmerge_ros.simulation import yard_scene
from mapmerge_ros.submap import Descriptors, DescriptorType, Source, SubMap

CONFIG = AssociationConfig()
COUNTS = (8, 16, 32, 64)
CELL = np.array([31.0, 23.0])
"""Of the grid that each drone has one cell of [m]."""
MARGIN = 4.0
"""That it sees of the neighbours' cells [m]."""
LANDMARKS = 1000
"""of a map"""
REPEATS = 3
"""The fastest counts: others may be at work on the machine."""


def growth() -> str:
    """Markdown table."""
    lines = [
        '| maps | pairs | overlapping | matched | overlapping, not matched | joined | '
        'joined wrongly | screening [s] | all [s] | exponent since 8 |',
        '|---' * 10 + '|',
    ]
    first = 0.0
    for count in COUNTS:
        submaps, seen = catalogues(count)
        runs = [timed(submaps) for _ in range(REPEATS)]
        chosen, matches, screening, seconds = min(runs, key=lambda run: run[3])
        first = first or seconds
        joined = {
            pair
            for pair, match in zip(chosen, matches, strict=True)
            if match.decision is Decision.JOINED
        }
        common = {
            (i, j): len(np.intersect1d(seen[i], seen[j])) for i, j in combinations(range(count), 2)
        }
        overlapping = {pair for pair, shared in common.items() if shared >= 10}
        wrong = sum(common[pair] == 0 for pair in joined)
        exponent = np.log(seconds / first) / np.log(count / COUNTS[0]) if count > COUNTS[0] else 0
        lines.append(
            f'| {count} | {len(common)} | {len(overlapping)} | {len(chosen)} | '
            f'{len(overlapping - set(chosen))} | {len(joined)} | {wrong} | '
            f'{screening:.2f} | {seconds:.2f} | {f"{exponent:.2f}" if exponent else "–"} |'
        )
    return '\n'.join(lines)


def timed(
    submaps: list[SubMap],
) -> tuple[tuple[tuple[int, int], ...], list[PairMatch], float, float]:
    """Pairs, their matches, processor seconds of the screening and of all."""
    begin = time.process_time()
    chosen = screen(submaps, CONFIG)
    screening = time.process_time() - begin
    matches = [match_pair(submaps[i], submaps[j], CONFIG) for i, j in chosen]
    return chosen, matches, screening, time.process_time() - begin


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


def announcement(name: str, points: np.ndarray, descriptors: np.ndarray) -> SubMap:
    """A map that says where its landmarks are and what they look like."""
    return SubMap(
        map_id=name,
        robot_id=name,
        revision=1,
        stamp_ns=0,
        frame_id=name,
        sources=(Source(name, 1),),
        gauge=Gauge.SIMILARITY,
        id_space='',
        landmark_ids=np.arange(1, len(points) + 1, dtype=np.uint64),
        points=points,
        covariances=None,
        compressed_count=0,
        a=0.0,
        packed_r=np.zeros(0, np.float32),
        c=np.zeros(0),
        residual_count=0,
        dof=0,
        sigma=1.0,
        descriptors=Descriptors(DescriptorType.BINARY, descriptors),
    )
