# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge info`: what is inside a recording."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

from rich.table import Table

from mapmerge_ros.cli import console, options
from mapmerge_ros.cli.options import Subparsers
from mapmerge_ros.fusion import Pair
from mapmerge_ros.fusion.associate import associate_by_id
from mapmerge_ros.io import Recorded, Recording
from mapmerge_ros.io.wording import counted, readable_bytes
from mapmerge_ros.submap import SubMap

MAX_PAIRS = 40
"""Rows of the table of pairs; the strongest come first."""


def add_parser(subparsers: Subparsers) -> None:
    """Register the command."""
    parser = options.add_command(
        subparsers,
        'info',
        'what is inside a recording',
        'Show the sub-maps of recordings, and how many compressed landmarks of equal id each\n'
        'pair of them shares.',
        '  mapmerge info site.mcap\n  mapmerge info drone0.mcap rosbag2_drone1/',
    )
    parser.add_argument(
        'bags', nargs='+', type=Path, metavar='BAG', help='.mcap file or rosbag2 folder'
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read and show."""
    with Recording(args.bags) as recording:
        messages = list(console.progress(recording, 'reading', recording.total))
    readable = [item for item in messages if item.submap is not None]
    screen = console.stdout()
    if readable:
        screen.print(_submaps_table(readable))
    pairs = shared_pairs(newest(readable))
    if pairs:
        screen.print(_pairs_table(pairs))
    elif readable:
        screen.print('No two sub-maps share a landmark id.')
    refused = [item for item in messages if item.submap is None]
    for item in refused:
        screen.print(f'unusable: {item.topic}: {item.refusal}', soft_wrap=True)
    total = readable_bytes(sum(item.size_bytes for item in messages))
    unusable = f', {len(refused)} unusable' if refused else ''
    screen.print(f'{counted(len(readable), "usable message")}{unusable}, {total}.')
    return 0


def newest(messages: Sequence[Recorded]) -> tuple[SubMap, ...]:
    """Newest revision of every map_id, in order of map_id."""
    latest: dict[str, SubMap] = {}
    for item in messages:
        submap = item.submap
        if submap is None:
            continue
        known = latest.get(submap.map_id)
        if known is None or known.revision < submap.revision:
            latest[submap.map_id] = submap
    return tuple(latest[map_id] for map_id in sorted(latest))


def shared_pairs(submaps: Sequence[SubMap]) -> tuple[Pair, ...]:
    """Pairs with compressed landmarks of equal id in one id space, strongest first."""
    if not submaps:
        return ()
    counts = associate_by_id(submaps).shared_counts()
    pairs = [
        Pair(submaps[a].map_id, submaps[b].map_id, int(counts[a, b]))
        for a, b in combinations(range(len(submaps)), 2)
        if counts[a, b]
    ]
    return tuple(sorted(pairs, key=lambda pair: -pair.shared))


def _submaps_table(messages: Sequence[Recorded]) -> Table:
    shown = console.table(
        '#t s', 'sub-map', 'robot', '#revision', '#landmarks', '#compressed',
        '#gauge', 'id space', 'descriptors', '#σ px', '#bytes',
    )  # fmt: skip
    start_ns = messages[0].log_time_ns
    for item in messages:
        submap = item.submap
        if submap is None:
            continue
        kind = submap.descriptors
        shown.add_row(
            f'{(item.log_time_ns - start_ns) / 1e9:.1f}',
            submap.map_id,
            submap.robot_id,
            str(submap.revision),
            str(len(submap.landmark_ids)),
            str(submap.compressed_count) if submap.compressed_count else 'announced',
            str(int(submap.gauge)),
            submap.id_space or 'private',
            f'{kind.type.name.lower()} {kind.size}' if kind.size else 'none',
            console.sigma(submap),
            readable_bytes(item.size_bytes),
        )
    return shown


def _pairs_table(pairs: Sequence[Pair]) -> Table:
    shown = console.table('sub-map', 'sub-map', '#shared')
    for pair in pairs[:MAX_PAIRS]:
        shown.add_row(pair.a, pair.b, str(pair.shared))
    if len(pairs) > MAX_PAIRS:
        shown.caption = f'{len(pairs) - MAX_PAIRS} weaker pairs not shown'
    return shown
