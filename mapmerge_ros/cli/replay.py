# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge replay`: recordings through the engine of the node, in the time of the recording."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from mapmerge_ros.cli import console, options
from mapmerge_ros.cli.options import Subparsers, UsageError
from mapmerge_ros.cli.outputs import output_folder
from mapmerge_ros.cli.playback import Playback, play
from mapmerge_ros.errors import DegenerateGeometry, InvalidValue
from mapmerge_ros.fusion import Fusion, FusionConfig, State
from mapmerge_ros.io.exports import global_map_mcap, global_map_ply, landmarks_csv, write_files
from mapmerge_ros.io.match_rows import tally
from mapmerge_ros.io.report import report_html
from mapmerge_ros.io.summary import Traffic, summarise, summary_json
from mapmerge_ros.io.truth import TruthComparison, compare_with_truth, load_truth, truth_path
from mapmerge_ros.io.wording import (
    against_truth,
    left_out,
    readable_bytes,
    verdict_sentences,
)

NANOSECONDS = 1_000_000_000
DEFAULTS = FusionConfig()


def add_parser(subparsers: Subparsers, summary: str) -> None:
    """Register the command."""
    parser = options.add_command(
        subparsers,
        'replay',
        summary,
        'Replay recorded sub-maps (mcap file or rosbag2 folder) through the engine of the\n'
        'fusion node, its timer in the time of the recording: the same files give the same map\n'
        'at any rate. Writes summary.json, landmarks.csv, global_map.mcap, global_map.ply and\n'
        'report.html. The exit code is 0 also where the test does not believe the merge.',
        '  mapmerge replay site.mcap\n'
        '  mapmerge replay drone0.mcap drone1.mcap --out merged --min-shared 8\n'
        '  mapmerge replay east.mcap --map-id east/0; mapmerge replay west.mcap --map-id west/0\n'
        '  mapmerge replay east_merged/global_map.mcap west_merged/global_map.mcap',
    )
    add = parser.add_argument
    add('bags', nargs='+', type=Path, metavar='BAG', help='.mcap file or rosbag2 folder')
    add(
        '--out',
        type=Path,
        metavar='DIR',
        help='folder of the results (default: name of the first bag + _merged, here)',
    )
    add(
        '--rate',
        type=_rate,
        default=None,
        metavar='R|max',
        help='times as fast as recorded, or max: no waiting (default)',
    )
    add(
        '--merge-period',
        type=options.positive,
        default=1.0,
        metavar='S',
        help='seconds of bag time between merges (default: %(default)s)',
    )
    add(
        '--min-shared',
        type=options.positive_int,
        default=DEFAULTS.min_shared,
        metavar='N',
        help='landmarks two sub-maps must share to be joined (default: %(default)s)',
    )
    add(
        '--significance',
        type=options.probability,
        default=DEFAULTS.significance,
        metavar='P',
        help='the merge is not believed below this p-value (default: %(default)s)',
    )
    add(
        '--max-landmarks',
        type=options.positive_int,
        default=DEFAULTS.max_landmarks,
        metavar='N',
        help='landmarks the global map stays compressed to (default: %(default)s)',
    )
    add(
        '--map-id',
        type=options.name,
        default=DEFAULTS.map_id,
        metavar='ID',
        help='map_id of the merged map; give each its own if they are to be merged again '
        '(default: %(default)s)',
    )
    add(
        '--resume',
        type=Path,
        metavar='STATE',
        help='go on from a state that the service ~/save_map of a fusion node has written',
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Replay, write the results, show them."""
    config = _config(args)
    period_ns = max(round(args.merge_period * NANOSECONDS), 1)
    truth_file = truth_path(args.bags[0])
    with play(args.bags, config, period_ns, args.rate, args.resume) as playback:
        folder = args.out or default_folder(args.bags[0])
        with output_folder(folder):
            fusion = playback.run()
            truth = _compare(fusion, truth_file) if len(args.bags) == 1 else None
            files = write_results(folder, fusion, playback.traffic, args.bags, truth)
    _show(fusion, playback, truth, files)
    return 0


def default_folder(bag: Path) -> Path:
    """Folder of the results beside where the user stands."""
    name = bag.resolve().name
    return Path(f'{name if bag.is_dir() else Path(name).stem}_merged')


def write_results(
    folder: Path,
    fusion: Fusion,
    traffic: Traffic,
    sources: Sequence[Path],
    truth: TruthComparison | None = None,
    more: Mapping[str, bytes] | None = None,
) -> tuple[Path, ...]:
    """
    Write all result files, and `more`; none of them appears before all are complete.

    Raises
    ------
    OutputError
        One of them cannot be written.

    """
    summary = summarise(fusion, traffic)
    if truth:
        summary['truth'] = {
            'count': truth.count,
            'median_error': truth.median_error,
            'rmse': truth.rmse,
            'radius': truth.radius,
        }
    title = ', '.join(source.resolve().name for source in sources)
    return write_files(
        folder,
        {
            'summary.json': summary_json(summary),
            'landmarks.csv': landmarks_csv(fusion),
            'global_map.mcap': global_map_mcap(fusion),
            'global_map.ply': global_map_ply(fusion),
            'report.html': report_html(fusion, summary, title, truth),
            **(more or {}),
        },
    )


def _config(args: argparse.Namespace) -> FusionConfig:
    try:
        return FusionConfig(
            map_id=args.map_id,
            min_shared=args.min_shared,
            significance=args.significance,
            max_landmarks=args.max_landmarks,
            ask=False,
        )
    except InvalidValue as err:
        field, _, reason = str(err).partition(':')
        raise UsageError(f'--{field.replace("_", "-")}:{reason}') from err


def _rate(text: str) -> float | None:
    return None if text == 'max' else options.positive(text)


def _compare(fusion: Fusion, path: Path) -> TruthComparison | None:
    """Comparison with the truth of a simulated recording, where it lies beside it."""
    if not path.exists() or not fusion.in_state(State.MERGED):
        return None
    truth = load_truth(path)
    leaves = {source.map_id for item in fusion.alignments for source in item.submap.sources}
    if unknown := leaves - {true_map.map_id for true_map in truth.maps}:
        console.warn(f'{path}: it is about another recording: {min(unknown)} is not in it')
        return None
    try:
        return compare_with_truth(fusion, truth)
    except DegenerateGeometry as err:
        console.warn(f'{path}: {err}')
        return None


def _show(
    fusion: Fusion, playback: Playback, truth: TruthComparison | None, files: Sequence[Path]
) -> None:
    shown = console.table(
        'sub-map', '#revision', '#compressed', '#σ px', '#scale', 'state', '#bytes'
    )
    sizes = {row['map_id']: row['bytes'] for row in summarise(fusion)['sub_maps']}
    for item in fusion.alignments:
        has_frame = item.component >= 0
        shown.add_row(
            item.submap.map_id,
            str(item.submap.revision),
            console.compressed(item.submap),
            console.sigma(item.submap),
            f'{item.S_global_map.scale:.4g}' if has_frame else '–',
            item.state.name.lower(),
            readable_bytes(sizes[item.submap.map_id]),
        )
    screen = console.stdout()
    screen.print(shown)
    for item in left_out(fusion):
        reason = f'{item.submap.map_id} {item.state.name.lower()}: {item.reason}'
        screen.print(reason, soft_wrap=True)
    for refused in playback.traffic.refused:
        screen.print(f'not taken in: {refused.name}: {refused.reason}', soft_wrap=True)
    if fusion.matches:
        screen.print(tally(fusion.matches), soft_wrap=True)
    screen.print(verdict_sentences(fusion), soft_wrap=True)
    if truth:
        screen.print(against_truth(truth), soft_wrap=True)
    if fusion.in_state(State.MERGED):
        screen.print(f'Last merge: {1000 * fusion.timing.total_s:.0f} ms.', soft_wrap=True)
    names = ' '.join(path.name for path in files)
    screen.print(f'{files[0].parent}: {names}', soft_wrap=True)
