# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge salvage`: what can still be read of a damaged recording, as a whole one."""

from __future__ import annotations

import argparse
from pathlib import Path

from mapmerge_ros.cli import console, options
from mapmerge_ros.cli.options import Subparsers, UsageError
from mapmerge_ros.cli.outputs import check_file
from mapmerge_ros.io.salvage import Salvaged, salvage
from mapmerge_ros.io.wording import counted

NS_PER_S = 1e9


def add_parser(subparsers: Subparsers, summary: str) -> None:
    """Register the command."""
    parser = options.add_command(
        subparsers,
        'salvage',
        summary,
        'Copy every message that can be read of a damaged .mcap file into a new one: of a\n'
        'recording that broke off (no power, a full disk, kill -9), or with wrong bytes inside.\n'
        'A recording of `mapmerge record` that never ended is called .NAME.PID.part.',
        '  mapmerge salvage broken.mcap -o site.mcap',
    )
    parser.add_argument('bag', type=Path, metavar='BAG', help='a damaged .mcap file')
    parser.add_argument(
        '-o', '--out', type=Path, required=True, metavar='FILE', help='a new .mcap file'
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Copy, and say what there was."""
    if args.out.exists() and args.bag.exists() and args.out.samefile(args.bag):
        raise UsageError(f'--out: {args.out}: is the damaged file itself: give another name')
    check_file(args.out, '.mcap')
    with console.working('reading'):
        found = salvage(args.bag, args.out)
    screen = console.stdout()
    for topic, count in sorted(found.topics.items()):
        screen.print(f'{topic}: {counted(count, "message")}', soft_wrap=True)
    screen.print(f'{args.out}: {in_words(found)}', soft_wrap=True)
    return 0


def in_words(found: Salvaged) -> str:
    """Say how much there was, and what was lost."""
    seconds = (found.last_ns - found.first_ns) / NS_PER_S
    said = f'{counted(found.messages, "message")} over {seconds:.3g} s'
    if found.is_whole:
        return f'{said}; nothing is wrong with the recording'
    lost = f'{counted(found.lost, "part")} inside cannot be read' if found.lost else ''
    end = f'it breaks off there ({found.broke_off})' if found.broke_off else ''
    return '; '.join(filter(None, [said, lost, end]))
