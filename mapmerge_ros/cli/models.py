# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""COLMAP models named on the command line: what `compress` and `refine` have in common."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from mapmerge_ros.bundle import Bundle, MapName
from mapmerge_ros.cli import console, options
from mapmerge_ros.cli.names import robot_names
from mapmerge_ros.io import read_colmap
from mapmerge_ros.io.wording import without_parallax

FIRST_STAMP_NS = STEP_NS = 1_000_000
"""Models have no time of their own: a millisecond apart, in the order in which they are named."""

DEFAULT_CAP = 500
"""Matched landmarks of one model, 4.5 MB: all that real SLAM sessions share; strips share 5000."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the models and what has to be known of them."""
    add = parser.add_argument
    add('models', nargs='+', type=Path, metavar='MODEL', help='folder of a COLMAP model')
    add('--robot', type=options.name, metavar='NAME', help='all models are maps of this robot')
    add(
        '--id-space',
        type=options.name,
        metavar='NAME',
        help='the point3D ids of all models of this NAME mean the same points',
    )
    add(
        '--max-landmarks',
        type=options.positive_int,
        default=DEFAULT_CAP,
        metavar='N',
        help='at most so many matched points per model (default: %(default)s)',
    )
    add(
        '--gauge',
        type=options.gauge,
        default=options.gauge('7'),
        metavar='7|6|4',
        help='7 monocular (default), 6 metric scale, 4 metric with z up',
    )
    add('--sigma', type=options.positive, metavar='PX', help='noise of an image coordinate')


def load(args: argparse.Namespace) -> list[Bundle]:
    """
    Read all models; says how many points of a map have no parallax and are left out.

    Raises
    ------
    ModelError
        One of them is not a usable COLMAP model.
    MissingExtraError
        pycolmap is not installed.

    """
    work = zip(args.models, map_names(args), strict=True)
    return [
        _load(model, name, args)
        for model, name in console.progress(work, 'reading', len(args.models))
    ]


def map_names(args: argparse.Namespace) -> list[MapName]:
    """One name per model, after its folder or the robot."""
    robots = [args.robot] * len(args.models) if args.robot else robot_names(args.models)
    return [
        MapName(
            map_id=f'{own}/{k if args.robot else 0:04d}',
            robot_id=own,
            stamp_ns=FIRST_STAMP_NS + k * STEP_NS,
            id_space=args.id_space or '',
        )
        for k, own in enumerate(robots)
    ]


def _load(model: Path, name: MapName, args: argparse.Namespace) -> Bundle:
    found = read_colmap(model, args.gauge)
    if found.undetermined:
        console.warn(f'{name.map_id}: {without_parallax(found.undetermined)}')
    bundle = found.bundle
    return bundle if args.sigma is None else replace(bundle, sigma_px=args.sigma)
