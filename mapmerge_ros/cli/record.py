# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge record`: everything that robots and fusion nodes tell each other, into one file."""

from __future__ import annotations

import argparse
import json
import re
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from mapmerge_ros.cli import options
from mapmerge_ros.cli.options import Subparsers, UsageError
from mapmerge_ros.errors import MapMergeError

NODE = 'mapmerge_ros.nodes.record_node'


class RosMissingError(MapMergeError):
    """The command needs ROS."""


def add_parser(subparsers: Subparsers, summary: str) -> None:
    """Register the command."""
    parser = options.add_command(
        subparsers,
        'record',
        summary,
        'Record every topic of mapmerge_msgs until Ctrl-C, latched messages from before\n'
        'included. The file appears when the recording ends. `ros2 bag play` and\n'
        '`mapmerge replay` take it.',
        "  mapmerge record -o site.mcap\n  mapmerge record -o red.mcap --topics '/red/.*'",
    )
    add = parser.add_argument
    add('-o', '--out', type=Path, required=True, metavar='FILE', help='an .mcap file')
    add(
        '--topics',
        default='.*',
        metavar='PATTERN',
        help='regular expression of whole topic names (default: all)',
    )
    add('--use-sim-time', action='store_true', help='take the time from /clock')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the node until it is interrupted."""
    if args.out.suffix != '.mcap':
        raise UsageError(f'--out: {args.out}: give a name that ends in .mcap')
    try:
        re.compile(args.topics)
    except re.error as err:
        raise UsageError(f'--topics: not a regular expression: {err}') from err
    if find_spec('rclpy') is None or find_spec('mapmerge_msgs') is None:
        raise RosMissingError('record needs ROS: pip install .[ros] ./msg_schemas')
    values = {
        'output': str(args.out),
        'pattern': args.topics,
        'use_sim_time': args.use_sim_time,
    }
    parameters = [x for key, value in values.items() for x in ('-p', f'{key}:={_yaml(value)}')]
    # In a session of its own: who interrupts only this process, by its id, ends the node as well,
    # and Ctrl-C in a terminal does not reach it twice.
    process = subprocess.Popen(
        [sys.executable, '-m', NODE, '--ros-args', *parameters], start_new_session=True
    )
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, frame: process.send_signal(signal.SIGINT))
    return process.wait()


def _yaml(value: object) -> str:
    """JSON is YAML, and keeps a text that looks like a number a text."""
    return json.dumps(value)
