# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Robots whose landmarks are chosen: real sessions with gold, drones with truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.bundle import Bundle, MapName
from mapmerge_ros.bundle.quality import TrackQuality
from mapmerge_ros.io import load_colmap
from mapmerge_ros.simulation import FleetConfig, simulate_fleet

FLEETS = {
    '4 drones': FleetConfig(drones=4, landmarks=500, keyframes=30),
    '9 drones': FleetConfig(drones=9, landmarks=500, keyframes=30),
}


@dataclass(frozen=True, eq=False)
class Robots:
    """Bundles, and where their points and cameras should be."""

    name: str
    bundles: tuple[Bundle, ...]
    points: tuple[Floats, ...]
    """Per robot (n, 3), one for each of the bundle's points"""
    centres: tuple[Floats, ...]
    """Per robot (m, 3)"""
    quality: TrackQuality | None
    """Of the choice; simulated robots have no bad tracks"""

    @property
    def names(self) -> list[MapName]:
        """Equal ids are equal points."""
        return [
            MapName(f'map{k:02d}', f'robot{k:02d}', stamp_ns=k + 1, id_space='truth')
            for k in range(len(self.bundles))
        ]


def real_robots(folder: Path) -> Robots:
    """Sessions of a data set, with the gold bundle."""
    bundles = tuple(load_colmap(path) for path in sorted(folder.glob('session_*')))
    gold, links = load_colmap(folder / 'gold'), np.load(folder / 'gold' / 'links.npz')
    points, centres = [], []
    for k, bundle in enumerate(bundles):
        ids, rows = links[f'session_{k}_point3D_id'], links[f'session_{k}_row']
        order = np.argsort(ids)
        own = order[np.searchsorted(ids[order], bundle.point_ids.astype(np.int64))]
        points.append(links['points'][rows[own]])
        centres.append(gold.centres_map()[links['session_of_image'] == k])
    return Robots(folder.name, bundles, tuple(points), tuple(centres), TrackQuality())


def simulated_robots(name: str, config: FleetConfig, seed: int) -> Robots:
    """Drones over a yard, with the truth."""
    fleet = simulate_fleet(config, seed=seed)
    truth = fleet.truth
    points = tuple(truth.points_world(ids) for ids in truth.landmark_ids)
    centres = tuple(bundle.centres_map() for bundle in truth.bundles)
    return Robots(name, fleet.bundles, points, centres, None)
