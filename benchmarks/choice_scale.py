# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What it takes to choose landmarks for many robots that have announced whole catalogues.

    python benchmarks/choice_scale.py [--robots 16 64 256 1024] [--markdown docs/throughput.md]

Robots over a square, each with a catalogue of 1000 points, half of them common to neighbours;
nothing is compressed yet, so everything is chosen. Each size in a process of its own: CPU seconds,
and growth of the peak of the memory, catalogues not counted.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from documents import published
from merge_steps import Values
from own_process import memory_growth, run_apart

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.association import number_by_id
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.fusion.catalogues import Tracks
from mapmerge_ros.fusion.requests import plan_requests
from mapmerge_ros.simulation.announcement import announcement
from mapmerge_ros.submap import Descriptors, SubMap

LANDMARKS = 1000

HEAD = ['| robots | asked | landmarks each | CPU seconds | memory [MB] |', '|---|---|---|---|---|']


def catalogues(robots: int, landmarks: int = LANDMARKS) -> list[SubMap]:
    """Robots in a square grid, each seeing a square of 1.2 from its place on."""
    rng = np.random.default_rng(robots)
    side = int(np.ceil(np.sqrt(robots)))
    count = round(landmarks * (side + 0.2) ** 2 / 1.2**2)
    points = rng.uniform([0.0, 0.0, 0.0], [side + 0.2, side + 0.2, 0.1], (count, 3))
    by_x = np.argsort(points[:, 0])
    points = points[by_x]
    fleet = []
    for k in range(robots):
        low = np.array([k // side, k % side], np.float64)
        start, stop = np.searchsorted(points[:, 0], [low[0], low[0] + 1.2])
        y = points[start:stop, 1]
        own = start + np.flatnonzero((y >= low[1]) & (y < low[1] + 1.2))
        fleet.append(_catalogue(f'robot{k:04d}', own, points[own] - np.r_[low, 0.0]))
    return fleet


def _catalogue(name: str, ids: Ints, points: Floats) -> SubMap:
    variances = np.zeros((len(ids), 6), np.float32)
    variances[:, [0, 3, 5]] = np.random.default_rng(ids).uniform(1e-8, 1e-6, (len(ids), 1))
    nothing = Descriptors.none(len(ids))
    return replace(
        announcement(name, points, nothing.rows, kind=nothing.type),
        id_space='square',
        landmark_ids=ids.astype(np.uint64),
        covariances=variances,
    )


def run(robots: int) -> Values:
    """Measure in this process."""
    fleet = catalogues(robots)
    tracks = Tracks(*number_by_id(fleet, [submap.landmark_ids for submap in fleet]))
    with memory_growth() as memory:
        start = time.process_time()
        requests = plan_requests(fleet, tracks, FusionConfig())
        seconds = time.process_time() - start
    chosen = [len(request.landmark_ids) for request in requests]
    return {
        'seconds': seconds,
        'asked': len(chosen),
        'landmarks': float(np.mean(chosen)),
        **memory,
    }


def rows(sizes: Sequence[int]) -> Iterator[str]:
    """Lines of the table."""
    for robots in sizes:
        found = run_apart(__file__, '--run', str(robots))
        cells = (robots, found['asked'], found['landmarks'], found['seconds'], found['growth_mb'])
        yield '| ' + ' | '.join(f'{cell:.4g}' for cell in cells) + ' |'


def main(argv: list[str] | None = None) -> int:
    """Print the table, and write it into a document when asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--robots', type=int, nargs='+', default=[16, 64, 256, 1024])
    parser.add_argument('--markdown', type=Path, help='document whose table is replaced')
    parser.add_argument('--run', type=int, help=argparse.SUPPRESS)
    args = parser.parse_args(argv)
    if args.run:
        print(json.dumps(run(args.run)))
        return 0
    return published(lambda: itertools.chain(HEAD, rows(args.robots)), args.markdown, 'scale')


if __name__ == '__main__':
    sys.exit(main())
