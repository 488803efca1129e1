# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge refine`: rounds of merging and linearising again, up to the full bundle."""

from __future__ import annotations

import argparse
import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from mapmerge_ros.bundle.selection import matched
from mapmerge_ros.cli import console, models, options
from mapmerge_ros.cli.options import Subparsers, UsageError
from mapmerge_ros.cli.outputs import output_folder
from mapmerge_ros.cli.replay import write_results
from mapmerge_ros.fusion import Fusion
from mapmerge_ros.fusion.refine import Robot, Round, refine
from mapmerge_ros.geometry.rotations import as_rotation
from mapmerge_ros.io import encode_submap
from mapmerge_ros.io.summary import Traffic
from mapmerge_ros.io.wording import verdict_sentences


def add_parser(subparsers: Subparsers, summary: str) -> None:
    """Register the command."""
    parser = options.add_command(
        subparsers,
        'refine',
        summary,
        'Merge models, hand the landmarks back, let every model re-optimise its own cameras and\n'
        'points, compress again, and so on: Gauss-Newton on the full bundle of all models, with\n'
        'nothing but compressed sub-maps exchanged. The true cost never rises.\n'
        'Writes what `replay` writes, and keyframes.csv: the corrected cameras in the global\n'
        'frame (position, and quaternion x y z w from camera to global).',
        '  mapmerge refine session_0 session_1 --id-space site --rounds 6 --out refined',
    )
    models.add_arguments(parser)
    add = parser.add_argument
    add('--rounds', type=options.positive_int, default=4, metavar='N', help='(default: 4)')
    add('--out', type=Path, default=Path('refined'), metavar='DIR', help='(default: refined)')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Load, run the rounds, write, show."""
    if not args.id_space:
        raise UsageError(
            '--id-space: give a NAME if equal point3D ids of the models are the same point'
        )
    if len(args.models) < 2:
        raise UsageError('MODEL: one model has nothing to be merged with')
    with output_folder(args.out) as folder:
        bundles = models.load(args)
        robots = [
            Robot(name, bundle, ids)
            for name, bundle, ids in zip(
                models.map_names(args),
                bundles,
                matched(bundles, args.max_landmarks),
                strict=True,
            )
        ]
        with console.working('merging and linearising again'):
            refined, rounds = refine(robots, args.rounds)
        fusion = rounds[-1].fusion
        files = write_results(
            folder,
            fusion,
            _traffic(fusion, len(rounds)),
            args.models,
            more={'keyframes.csv': keyframes_csv(refined, fusion)},
        )
    _show(rounds, files)
    return 0


def keyframes_csv(robots: Sequence[Robot], fusion: Fusion) -> bytes:
    """Corrected cameras of all merged robots in the global frame."""
    frames = {item.submap.map_id: item.S_global_map for item in fusion.alignments}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator='\n')
    writer.writerow(['map_id', 'keyframe_id', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'])
    for robot in robots:
        S_global_map, bundle = frames[robot.name.map_id], robot.bundle
        centres = S_global_map.apply(bundle.centres_map())
        turns = S_global_map.rotation @ bundle.rotations_camera_map.transpose(0, 2, 1)
        quaternions = as_rotation(turns).as_quat()
        for row, keyframe_id in enumerate(bundle.keyframe_ids):
            numbers = [repr(float(value)) for value in (*centres[row], *quaternions[row])]
            writer.writerow([robot.name.map_id, int(keyframe_id), *numbers])
    return text.getvalue().encode()


def _traffic(fusion: Fusion, rounds: int) -> Traffic:
    """One message a robot and round."""
    size_bytes = sum(len(encode_submap(item.submap)) for item in fusion.alignments)
    return Traffic(rounds * len(fusion.alignments), rounds * size_bytes)


def _show(rounds: Sequence[Round], files: Sequence[Path]) -> None:
    shown = console.table(
        '#round', '#true cost px²', '#change', '#largest step / σ', '#share taken', '#ã/(dof σ²)'
    )
    before = math.nan
    for number, each in enumerate(rounds, 1):
        change = (each.cost_px2 - before) / before
        before = each.cost_px2
        shown.add_row(
            str(number),
            f'{each.cost_px2:.9g}',
            '–' if math.isnan(change) else f'{change:.1e}',
            f'{each.step_ratio:.1e}' if math.isfinite(each.step_ratio) else '–',
            f'{each.share:g}',
            f'{each.fusion.verdict.variance_factor:.3f}',
        )
    screen = console.stdout()
    screen.print(shown)
    screen.print(verdict_sentences(rounds[-1].fusion), soft_wrap=True)
    names = ' '.join(path.name for path in files)
    screen.print(f'{files[0].parent}: {names}', soft_wrap=True)
