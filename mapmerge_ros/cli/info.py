# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge info`: what is inside a recording."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import scipy.sparse
from rich.table import Table

from mapmerge_ros.association import associate
from mapmerge_ros.cli import console, info_pairs, options
from mapmerge_ros.cli.options import Subparsers
from mapmerge_ros.fusion import Pair
from mapmerge_ros.fusion.associate import associate_by_id
from mapmerge_ros.fusion.outcome import Match
from mapmerge_ros.io import Recorded, Recording
from mapmerge_ros.io.wording import counted, readable_bytes
from mapmerge_ros.submap import SubMap

IN_THE_NAME = ''
"""Stands for the robot where every map_id begins with it."""

ABOUT_ALL = (
    'at {} s', '', 'robot {}', 'revision {}', '', '', 'gauge {}', 'id space {}',
    'descriptors {}', '', '',
)  # fmt: skip
"""How a column that says the same of every sub-map is put in words; empty = always a column."""


def add_parser(subparsers: Subparsers, summary: str) -> None:
    """Register the command."""
    parser = options.add_command(
        subparsers,
        'info',
        summary,
        'Show the sub-maps of recordings, and which of them show the same place: by equal ids\n'
        'within an id space, by descriptors and geometry elsewhere, with the reason where two\n'
        'are not joined.',
        '  mapmerge info site.mcap\n  mapmerge info drone0.mcap rosbag2_drone1/',
    )
    parser.add_argument(
        'bags', nargs='+', type=Path, metavar='BAG', help='.mcap file or rosbag2 folder'
    )
    parser.add_argument(
        '--all-pairs',
        action='store_true',
        help='show every pair; otherwise, of many, those that are joined and the best others',
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Read, compare and show."""
    with Recording(args.bags) as recording:
        messages = list(console.progress(recording, 'reading', recording.total))
    readable = [item for item in messages if item.submap is not None]
    maps = newest(readable)
    with console.working('matching'):
        matches = found_matches(maps)
    screen = console.stdout()
    if readable:
        shown, same = _submaps_table(readable)
        screen.print(shown)
        if same:
            screen.print(f'Each: {same}.', soft_wrap=True)
    info_pairs.show_shared(screen, maps, shared_pairs(maps))
    info_pairs.show_matches(screen, maps, matches, everything=args.all_pairs)
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
    shared = scipy.sparse.triu(associate_by_id(submaps).shared_counts(), 1, format='csr')
    counts = shared.sorted_indices().tocoo()
    pairs = [
        Pair(submaps[a].map_id, submaps[b].map_id, int(count))
        for a, b, count in zip(counts.row, counts.col, counts.data, strict=True)
    ]
    return tuple(sorted(pairs, key=lambda pair: -pair.shared))


def found_matches(submaps: Sequence[SubMap]) -> tuple[Match, ...]:
    """Pairs without a common id space, compared by descriptors."""
    found = associate(submaps)
    return tuple(
        Match(submaps[a].map_id, submaps[b].map_id, found.common(a, b), match)
        for (a, b), match in sorted(found.matches.items())
    )


def _submaps_table(messages: Sequence[Recorded]) -> tuple[Table, str]:
    """Table of the messages, and a line with what is the same for all of them."""
    columns = _columns(messages)
    same = {
        words: values[0]
        for words, (_, values) in zip(ABOUT_ALL, columns, strict=True)
        if words and len(set(values)) == 1
    }
    kept = [
        (heading, values)
        for words, (heading, values) in zip(ABOUT_ALL, columns, strict=True)
        if words not in same
    ]
    shown = console.table(*(heading for heading, _ in kept))
    for row in zip(*(values for _, values in kept), strict=True):
        shown.add_row(*row)
    said = (words.format(value) for words, value in same.items() if value != IN_THE_NAME)
    return shown, ', '.join(said)


def _columns(messages: Sequence[Recorded]) -> list[tuple[str, list[str]]]:
    """Headings and cells, in the order of `ABOUT_ALL`."""
    start_ns = messages[0].log_time_ns
    rows = [(item, item.submap) for item in messages if item.submap is not None]
    maps = [submap for _, submap in rows]
    seconds = [f'{(item.log_time_ns - start_ns) / 1e9:.1f}' for item, _ in rows]
    return [
        ('#t s', seconds),
        ('sub-map', [submap.map_id for submap in maps]),
        ('robot', _robots(maps)),
        ('#rev.', [str(submap.revision) for submap in maps]),
        ('#landmarks', [str(len(submap.landmark_ids)) for submap in maps]),
        ('#compressed', [console.compressed(submap) for submap in maps]),
        ('#gauge', [str(int(submap.gauge)) for submap in maps]),
        ('id space', [submap.id_space or 'private' for submap in maps]),
        ('descriptors', [_kind(submap) for submap in maps]),
        ('#σ px', [console.sigma(submap) for submap in maps]),
        ('#bytes', [readable_bytes(item.size_bytes) for item, _ in rows]),
    ]


def _robots(maps: Sequence[SubMap]) -> list[str]:
    """Names of the robots, unless each map_id begins with its own."""
    if all(submap.map_id.startswith(f'{submap.robot_id}/') for submap in maps):
        return [IN_THE_NAME] * len(maps)
    return [submap.robot_id for submap in maps]


def _kind(submap: SubMap) -> str:
    kind = submap.descriptors
    return f'{kind.type.name.lower()} {kind.size}' if kind.size else 'none'
