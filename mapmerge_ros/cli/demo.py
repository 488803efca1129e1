# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge demo`: the real nodes on real topics, and the result checked."""

from __future__ import annotations

import argparse
import importlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mapmerge_ros.cli import console, options
from mapmerge_ros.cli.demo_check import compare_arrived_with_truth, compare_with_replay, show
from mapmerge_ros.cli.demo_live import FUSION_NODE, DemoError, Heard, Stage, play_live
from mapmerge_ros.cli.options import Subparsers
from mapmerge_ros.cli.outputs import output_folder
from mapmerge_ros.cli.playback import play
from mapmerge_ros.cli.processes import local_environment
from mapmerge_ros.cli.replay import write_results
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.io.truth import RecordingTruth, TruthComparison, load_truth, truth_path

RECORDING = Path(__file__).resolve().parents[2] / 'bags' / 'four_drones.mcap'

PERIOD_NS = 1_000_000_000

STEP_S = 0.1
"""How long to wait for a message before the processes are looked at again."""


def add_parser(subparsers: Subparsers, summary: str) -> None:
    """Register the command."""
    parser = options.add_command(
        subparsers,
        'demo',
        summary,
        'Start one process for every robot of a recording and one for the fusion node, on this\n'
        'machine only and in a ROS domain of their own; show what arrives, and compare it with\n'
        'the replay of the same recording and with the truth beside it. The exit code is 0 if\n'
        'they agree.',
        '  mapmerge demo\n  mapmerge demo --recording drones.mcap --rate 10 --out drones_demo',
    )
    add = parser.add_argument
    add('--recording', type=Path, default=RECORDING, metavar='BAG', help='.mcap or rosbag2 folder')
    add('--out', type=Path, default=Path('demo_out'), metavar='DIR', help='folder of the results')
    for option, default, metavar, text in (
        ('--rate', 4.0, 'R', 'times as fast as recorded'),
        ('--timeout', 45.0, 'S', 'seconds to wait for the merged map'),
    ):
        add(
            option,
            type=options.positive,
            default=default,
            metavar=metavar,
            help=f'{text} (default: %(default)g)',
        )
    add('--domain', type=_domain, metavar='N', help='ROS domain, 0 to 101 (default: a free one)')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the demo, check what arrived, write and show the results."""
    _require_ros()
    if not args.recording.exists():
        raise DemoError(
            f'{args.recording}: no such recording: make one with `mapmerge simulate NAME.mcap` '
            'and give it with --recording'
        )
    config = FusionConfig(map_id=f'{FUSION_NODE}/global')
    screen = console.stdout()
    with (
        _stoppable(),
        play([args.recording], config, PERIOD_NS) as playback,
        output_folder(args.out) as folder,
    ):
        fusion = playback.run()
        stage = Stage(args.recording, args.rate, args.timeout, args.domain, folder / 'logs')
        arrived = play_live(stage, fusion, listening, screen)
        checks = compare_with_replay(arrived, fusion)
        truth = _load_truth(args.recording)
        found: TruthComparison | None = None
        if truth is not None:
            check, found = compare_arrived_with_truth(arrived, fusion, truth)
            checks.append(check)
        files = write_results(folder, fusion, playback.traffic, [args.recording], found)
    show(screen, fusion, found, checks, files)
    failed = [check.name for check in checks if not check.passed]
    if failed:
        raise DemoError(f'what arrived is not right: {", ".join(failed)}')
    screen.print('OK')
    return 0


@contextmanager
def listening(domain: int, fusion_node: str, heard: Heard) -> Iterator[Callable[[], None]]:
    """Listen to a fusion node of this machine; signals stay with the caller."""
    # Here and not above: every other command works without ROS.
    import rclpy
    from mapmerge_msgs.msg import AlignmentArray, FusionStatus, SubMap
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from rclpy.signals import SignalHandlerOptions

    os.environ.update(local_environment(domain))
    rclpy.init(
        args=['--ros-args', '--disable-external-lib-logs'],
        signal_handler_options=SignalHandlerOptions.NO,
    )
    node = rclpy.create_node('demo')
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    for kind, name, take in (
        (AlignmentArray, 'alignments', heard.take_alignments),
        (FusionStatus, 'status', heard.take_status),
    ):
        node.create_subscription(kind, f'{fusion_node}/{name}', take, latched)
    node.create_subscription(
        SubMap, f'{fusion_node}/global_map', heard.take_map, latched, raw=True
    )
    try:
        yield lambda: rclpy.spin_once(node, timeout_sec=STEP_S)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _load_truth(recording: Path) -> RecordingTruth | None:
    path = truth_path(recording)
    return load_truth(path) if path.exists() else None


def _require_ros() -> None:
    for module in ('rclpy', 'mapmerge_msgs.msg'):
        try:
            importlib.import_module(module)
        except ImportError as err:
            raise DemoError(
                f'{module} cannot be imported ({err}): run `make demo`, or '
                '`pip install mapmerge_ros[ros] ./msg_schemas`'
            ) from err


@contextmanager
def _stoppable() -> Iterator[None]:
    """Let SIGTERM end the block as an error does: nothing that was started stays behind."""
    before = signal.signal(signal.SIGTERM, lambda signum, frame: sys.exit(128 + signum))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _domain(text: str) -> int:
    if not text.isdecimal() or int(text) > 101:
        raise argparse.ArgumentTypeError(f'{text!r} is not a whole number from 0 to 101')
    return int(text)
