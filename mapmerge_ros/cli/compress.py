# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge compress`: COLMAP models to a recording of compressed sub-maps."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from mapmerge_ros.arrays import Ids
from mapmerge_ros.bundle import Bundle, MapName, compress, with_lens_prior
from mapmerge_ros.bundle.lens_prior import MIN_KEYFRAMES
from mapmerge_ros.cli import console, models, options
from mapmerge_ros.cli.choosing import Budget, choose
from mapmerge_ros.cli.options import Subparsers
from mapmerge_ros.cli.outputs import check_file, ros_name
from mapmerge_ros.errors import DegenerateGeometry, InvalidValue
from mapmerge_ros.io import MAX_MESSAGE_BYTES, encode_submap, write_submaps
from mapmerge_ros.io.wording import counted, readable_bytes
from mapmerge_ros.submap import SubMap

DEFAULT_TRACKS = 100
"""Landmarks of a single model: 184 kB; above about 114, R is larger than the observations."""

DEFAULT_LENS_PRIOR_PX = 0.0
"""
0: the lens is as calibrated. 0.12 px leaves open what a calibration leaves open: it halves ã where
maps are bent by it (Caliterra), and costs a factor of two in the distance to gold everywhere.
"""


def add_parser(subparsers: Subparsers, summary: str) -> None:
    """Register the command."""
    parser = options.add_command(
        subparsers,
        'compress',
        summary,
        'Turn COLMAP models into one compressed sub-map each, in one recording.\n'
        'A model is a folder with cameras, images, points3D (.bin or .txt), and optionally\n'
        'descriptors.npz (point_id int64[n], descriptors uint8[n, 128|64|48|32]).',
        '  mapmerge compress session_0 session_1 --id-space site -o site.mcap\n'
        '  mapmerge compress session_0 --landmarks 150 --sigma 0.7 -o drone0.mcap\n'
        '  mapmerge compress monday tuesday --robot rover --landmarks 100 -o rover.mcap',
    )
    add = parser.add_argument
    models.add_arguments(parser)
    add('-o', '--out', type=Path, required=True, metavar='OUT.mcap', help='recording to write')
    add(
        '--landmarks',
        type=_landmarks,
        metavar='matched|N|all',
        help='which points to compress: those that another model has too, by descriptors or, with '
        '--id-space, by id (default for several models); N: the N of these that say most, then '
        f'the longest tracks (default for one: {DEFAULT_TRACKS}); or all',
    )
    add(
        '--max-bytes',
        type=options.positive_int,
        metavar='B',
        help='largest message of a model, its catalogue included; fewer points are compressed',
    )
    add(
        '--good-tracks',
        action='store_true',
        help='leave out points with larger residuals than two thirds of their session and than '
        'four of their twelve neighbours, instead of taking them last',
    )
    add(
        '--lens-prior',
        type=options.non_negative,
        default=DEFAULT_LENS_PRIOR_PX,
        metavar='PX',
        help='how well each of seven lens parameters is known, as root-mean-square displacement '
        'in the image; R then leaves open how the lens may bend the map; 0 = exactly; needs '
        'images that share a camera (default: %(default)s)',
    )
    add('--no-catalogue', action='store_true', help='leave out what is not compressed')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Load, select, compress, write."""
    wanted = args.landmarks or ('matched' if len(args.models) > 1 else DEFAULT_TRACKS)
    names = models.map_names(args)
    check_file(args.out, '.mcap')
    bundles = models.load(args)
    budget = Budget(args.max_landmarks, args.max_bytes or 0, not args.no_catalogue)
    chosen = choose(bundles, names, wanted, budget, args.good_tracks)
    bundles = [
        with_uncertain_lens(bundle, name, args.lens_prior)
        for bundle, name in zip(bundles, names, strict=True)
    ]
    work = zip(bundles, names, chosen, strict=True)
    submaps = [
        compress_or_announce(bundle, name, ids, catalogue=not args.no_catalogue)
        for bundle, name, ids in console.progress(work, 'compressing', len(names))
    ]
    write_submaps(
        args.out,
        ((f'/{ros_name(submap.robot_id)}/submap', submap.stamp_ns, submap) for submap in submaps),
    )
    _show(bundles, submaps, args.out)
    return 0


def with_uncertain_lens(bundle: Bundle, name: MapName, prior_px: float) -> Bundle:
    """Return the bundle with its lens known to `prior_px`, or as it is if that means nothing."""
    uncertain = with_lens_prior(bundle, prior_px)
    if prior_px and not uncertain.lens.size:
        console.warn(
            f'{name.map_id}: lens taken as exact: no camera is shared by {MIN_KEYFRAMES} images'
        )
    return uncertain


def compress_or_announce(
    bundle: Bundle, name: MapName, ids: Ids, *, catalogue: bool = True
) -> SubMap:
    """
    Compress a bundle, or just announce it if these points cannot carry it.

    Raises
    ------
    InvalidValue
        The message would be too large.

    """
    size_bytes = 4 * (3 * len(ids)) ** 2 // 2
    if size_bytes > MAX_MESSAGE_BYTES:
        raise InvalidValue(
            f'{name.map_id}: {len(ids)} landmarks make a message of '
            f'{readable_bytes(size_bytes)}: choose fewer, --landmarks N or --max-landmarks N'
        )
    try:
        if len(ids) < bundle.gauge.minimal_points:
            raise DegenerateGeometry(
                f'{bundle.gauge.minimal_points} landmarks are the least for gauge {bundle.gauge:d}'
            )
        return compress(bundle, name, ids, catalogue=catalogue)
    except DegenerateGeometry as err:
        console.warn(f'{name.map_id}: only announced, has {len(ids)} landmarks to share: {err}')
        return compress(bundle, name, ids[:0])


def _landmarks(text: str) -> str | int:
    if text in ('matched', 'all'):
        return text
    try:
        return options.positive_int(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f'{text!r} is not matched, all or a number') from None


def _show(bundles: Sequence[Bundle], submaps: Sequence[SubMap], out: Path) -> None:
    shown = console.table(
        'sub-map', '#key frames', '#points', '#observations', '#compressed', '#σ px', '#bytes'
    )
    total = 0
    for bundle, submap in zip(bundles, submaps, strict=True):
        size_bytes = len(encode_submap(submap))
        total += size_bytes
        shown.add_row(
            submap.map_id,
            str(len(bundle.keyframe_ids)),
            str(len(bundle.point_ids)),
            str(len(bundle.observations_px)),
            str(submap.compressed_count) if submap.compressed_count else 'announced',
            console.sigma(submap),
            readable_bytes(size_bytes),
        )
    screen = console.stdout()
    screen.print(shown)
    summary = f'{counted(len(submaps), "sub-map")}, {readable_bytes(total)}'
    screen.print(f'{summary}: {out}', soft_wrap=True)
