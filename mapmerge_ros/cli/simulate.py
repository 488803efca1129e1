# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`mapmerge simulate`: drones over a yard as a recording, with the truth beside it."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mapmerge_ros.arrays import Ids
from mapmerge_ros.bundle import compress
from mapmerge_ros.cli import console, options
from mapmerge_ros.cli.options import Subparsers
from mapmerge_ros.cli.outputs import check_file, ros_name
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.fusion.offline import choose_for_bundles
from mapmerge_ros.io import McapRecorder, NamedBundle, encode_bundle, record, replacing
from mapmerge_ros.io.truth import (
    RecordingTruth,
    TrueMap,
    TrueMove,
    TrueStay,
    truth_json,
    truth_path,
)
from mapmerge_ros.io.typestore import BUNDLE
from mapmerge_ros.io.wording import counted, readable_bytes
from mapmerge_ros.simulation import Fleet, FleetConfig, Sensing, simulate_fleet
from mapmerge_ros.submap import SubMap

RECORDING_NS = 20_000_000_000
"""Length of a recording: long enough to watch a map grow, short enough to wait for."""

FLEET, SENSING, FUSION = FleetConfig(), Sensing(), FusionConfig()


def add_parser(subparsers: Subparsers, summary: str) -> None:
    """Register the command."""
    parser = options.add_command(
        subparsers,
        'simulate',
        summary,
        'Fly drones over a simulated yard, bundle the map of each and write their compressed\n'
        'sub-maps as a recording, one after the other. What is true goes to OUT.truth.json\n'
        'beside OUT.mcap; replay then says how far the merged map is from it.',
        '  mapmerge simulate drones.mcap\n'
        '  mapmerge simulate moved.mcap --drones 6 --moved 2 --removed 1 --seed 7\n'
        '  mapmerge simulate vio.mcap --gauge 4 --sigma 1.0\n'
        '  mapmerge simulate strangers.mcap --ids private --flips 0.1',
    )
    add = parser.add_argument
    add('out', type=Path, metavar='OUT.mcap', help='recording to write')
    count, number = options.positive_int, options.positive
    for option, kind, metavar, default, text in (
        ('--drones', count, 'N', FLEET.drones, 'number of drones'),
        ('--seed', options.natural, 'N', 0, 'the same seed gives the same recording'),
        ('--keyframes', count, 'N', FLEET.keyframes, 'key frames per drone'),
        ('--landmarks', count, 'N', FLEET.landmarks, 'landmarks in the cell of a drone'),
        ('--sigma', number, 'PX', SENSING.sigma_px, 'noise of an image coordinate'),
        ('--moved', options.natural, 'N', 0, 'objects that are moved between two visits'),
        ('--moved-distance', number, 'M', FLEET.moved_distance, 'by how many metres'),
        ('--added', options.natural, 'N', 0, 'objects that come between two visits'),
        ('--removed', options.natural, 'N', 0, 'objects that are taken away between two visits'),
    ):
        help_text = f'{text} (default: %(default)s)'
        add(option, type=kind, metavar=metavar, default=default, help=help_text)
    add(
        '--gauge',
        type=options.gauge,
        default=SENSING.gauge,
        metavar='7|6|4',
        help='7 monocular (default), 6 metric scale, 4 metric with z up',
    )
    add(
        '--ids',
        choices=('fleet', 'private'),
        default=FLEET.ids,
        help='fleet: equal ids are the same landmark (default); private: every drone numbers '
        'its own, matching is by descriptors',
    )
    add(
        '--flips',
        type=options.probability,
        default=SENSING.flip_ratio,
        metavar='SHARE',
        help='of the bits of a descriptor, those that a drone sees wrongly; up to 0.1 is usual '
        'for ORB (default: %(default)s)',
    )
    add('--no-descriptors', action='store_true', help='landmarks without descriptors')
    add('--no-catalogue', action='store_true', help='leave out what is not compressed')
    add(
        '--bundles',
        action='store_true',
        help='record the bundle of each drone too, for compressor_node',
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Simulate and write."""
    check_file(args.out, '.mcap')
    config = FleetConfig(
        drones=args.drones,
        keyframes=args.keyframes,
        landmarks=args.landmarks,
        sensing=Sensing(sigma_px=args.sigma, gauge=args.gauge, flip_ratio=args.flips),
        ids=args.ids,
        descriptors=not args.no_descriptors,
        moved=args.moved,
        moved_distance=args.moved_distance,
        added=args.added,
        removed=args.removed,
    )
    with console.working('simulating'):
        fleet = simulate_fleet(config, args.seed)
        submaps = recorded_submaps(fleet, catalogue=not args.no_catalogue)
    truth_file = truth_path(args.out)
    # Nested, so that neither of the two appears without the other.
    with replacing(truth_file) as stream:
        stream.write(truth_json(recording_truth(fleet)))
        with record(args.out) as recorder:
            size_bytes = sum(
                recorder.write_submap(
                    f'/{ros_name(submap.robot_id)}/submap', submap.stamp_ns, submap
                )
                for submap in submaps
            )
            if args.bundles:
                _record_bundles(recorder, fleet, submaps)
    changes = ''.join(
        f', {counted(count, "object")} {what}'
        for what in ('moved', 'added', 'removed')
        if (count := getattr(args, what))
    )
    compressed = sum(submap.compressed_count for submap in submaps)
    if announced := [submap.map_id for submap in submaps if not submap.compressed_count]:
        console.warn(
            f'only announced, nothing found in common with others: {", ".join(announced)}; '
            'mapmerge info says why'
        )
    screen = console.stdout()
    screen.print(
        f'{counted(len(submaps), "drone")}, {compressed} compressed landmarks, '
        f'{readable_bytes(size_bytes)}{changes}: {args.out} {truth_file.name}',
        soft_wrap=True,
    )
    return 0


def _record_bundles(recorder: McapRecorder, fleet: Fleet, submaps: Sequence[SubMap]) -> None:
    """Record the bundle of every drone at the time of its sub-map."""
    for name, bundle, submap in zip(fleet.names, fleet.bundles, submaps, strict=True):
        stamps_ns = (submap.stamp_ns,) * len(bundle.keyframe_ids)
        named = NamedBundle(replace(name, stamp_ns=submap.stamp_ns), bundle, stamps_ns)
        topic = f'/{ros_name(name.robot_id)}/bundle'
        recorder.write_bytes(topic, submap.stamp_ns, BUNDLE, encode_bundle(named))


def recorded_submaps(fleet: Fleet, *, catalogue: bool = True) -> tuple[SubMap, ...]:
    """Sub-maps of a fleet, their stamps spread over the length of a recording."""
    step_ns = RECORDING_NS // len(fleet.bundles)
    work = zip(fleet.bundles, fleet.names, compressed_ids(fleet), strict=True)
    return tuple(
        replace(compress(bundle, name, ids, catalogue=catalogue), stamp_ns=(k + 1) * step_ns)
        for k, (bundle, name, ids) in enumerate(work)
    )


def compressed_ids(fleet: Fleet) -> tuple[Ids, ...]:
    """
    Points that each drone compresses.

    Those that another one has too where ids tell; with private ids what a fusion node that
    hears the announcements would ask for, since nobody knows the truth. A drone that nothing
    can be asked of announces.
    """
    if all(name.id_space for name in fleet.names):
        return tuple(
            bundle.point_ids[fleet.shared_rows(k)] for k, bundle in enumerate(fleet.bundles)
        )
    chosen = choose_for_bundles(fleet.bundles, fleet.names, FUSION.request_landmarks)
    return tuple(
        ids if len(ids) >= bundle.gauge.minimal_points else ids[:0]
        for ids, bundle in zip(chosen, fleet.bundles, strict=True)
    )


def recording_truth(fleet: Fleet) -> RecordingTruth:
    """Truth about a fleet, as it goes beside the recording."""
    truth = fleet.truth
    seen = np.unique(np.concatenate(truth.landmark_ids))
    return RecordingTruth(
        landmark_ids=seen,
        points_world=truth.points_world(seen),
        maps=tuple(_true_map(fleet, robot) for robot in range(len(fleet.bundles))),
        moved=tuple(
            TrueMove(
                landmark_ids=moved.landmark_ids,
                map_ids=tuple(name.map_id for name in fleet.names[moved.first_visit_after :]),
                displacement_world=moved.displacement_world,
            )
            for moved in truth.moved
        ),
        temporary=tuple(
            TrueStay(
                stay.landmark_ids,
                tuple(n.map_id for k, n in enumerate(fleet.names) if stay.is_there(k)),
            )
            for stay in truth.temporary
        ),
    )


def _true_map(fleet: Fleet, robot: int) -> TrueMap:
    name, bundle = fleet.names[robot], fleet.bundles[robot]
    is_private = not name.id_space
    return TrueMap(
        map_id=name.map_id,
        robot_id=name.robot_id,
        S_world_map=fleet.truth.S_world_map[robot],
        own_ids=bundle.point_ids if is_private else bundle.point_ids[:0],
        true_ids=fleet.truth.landmark_ids[robot] if is_private else bundle.point_ids[:0],
    )
