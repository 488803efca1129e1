# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A street of identical façades with rows of identical windows: the trap of place recognition."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mapmerge_ros.arrays import Bytes, Floats, Ints
from mapmerge_ros.bundle import Bundle, MapName
from mapmerge_ros.simulation.drones import Sensing, fly
from mapmerge_ros.simulation.scene import DESCRIPTOR_BYTES, Scene
from mapmerge_ros.simulation.trajectory import Trajectory, look_at


@dataclass(frozen=True, slots=True)
class StreetConfig:
    """Façades in a row along x, each visited by `drones_per_facade` drones one after the other."""

    facades: int = 6
    drones_per_facade: int = 2
    floors: int = 4
    columns: int = 8
    """Windows in a row."""
    elements: int = 8
    """Landmarks of one window: the same in every window of the street."""
    unique: int = 60
    """Landmarks of each façade that no other one has: doors, signs, plants before it."""
    pitch: tuple[float, float] = (2.2, 2.8)
    """From window to window and from floor to floor [m]."""
    gap: float = 20.0
    """Between two façades [m]; a drone before one of them does not see the next."""
    coverage: float = 0.5
    """Share of its façade that a drone flies along: from the left end, or from the right."""
    distance: float = 7.0
    """Of the drones from the façade [m]."""
    keyframes: int = 16
    place_flip_ratio: float = 0.02
    """Bits that tell the place of a window in its façade (light, view): alike on all façades."""
    own_flip_ratio: float = 0.08
    """Bits that tell a landmark from the same element of another window (dirt, curtains)."""
    sensing: Sensing = field(default_factory=Sensing)

    @property
    def width(self) -> float:
        """Of a façade [m]."""
        return self.columns * self.pitch[0]


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """The maps of the drones, private ids, and what is true about them."""

    bundles: tuple[Bundle, ...]
    names: tuple[MapName, ...]
    facades: tuple[int, ...]
    """Which façade each drone has seen."""
    landmark_ids: tuple[Ints, ...]
    """per drone: (n,) id in the scene of each of its points"""


def simulate_street(config: StreetConfig | None = None, seed: int = 0) -> Street:
    """
    Fly drones along the façades; those before different façades have no landmark in common.

    Raises
    ------
    SimulationError
        A drone sees too little.
    AdjustmentError
        pycolmap is missing, or a map could not be adjusted.

    """
    config = config or StreetConfig()
    visits = np.repeat(np.arange(config.facades), config.drones_per_facade)
    site, *robots = np.random.default_rng(seed).spawn(1 + len(visits))
    scene = street_scene(site, config)
    sessions = [
        fly(rng, scene, _along(rng, drone, config), config.sensing, private_ids=True)
        for drone, rng in enumerate(robots)
    ]
    return Street(
        bundles=tuple(session.bundle for session in sessions),
        names=tuple(_name(drone) for drone in range(len(visits))),
        facades=tuple(map(int, visits)),
        landmark_ids=tuple(session.landmark_ids.astype(np.int64) for session in sessions),
    )


def street_scene(rng: np.random.Generator, config: StreetConfig) -> Scene:
    """Landmarks of the whole street; surface i is façade i."""
    window = rng.random((config.elements, 2)) * [0.6 * p for p in config.pitch]
    grid = np.stack(
        np.meshgrid(np.arange(config.columns), np.arange(config.floors), indexing='ij'), axis=-1
    ).reshape(-1, 2)
    corners = (grid[:, None] * config.pitch + window).reshape(-1, 2)
    looks = _window_looks(rng, config, len(grid))
    points, descriptors, surfaces = [], [], []
    for facade in range(config.facades):
        repeated = np.column_stack([corners[:, 0], np.zeros(len(corners)), corners[:, 1]])
        alone = _unique_points(rng, config)
        own = np.concatenate([repeated, alone])
        own[:, 0] += facade * (config.width + config.gap)
        points.append(own)
        fresh = rng.integers(0, 256, (config.unique, DESCRIPTOR_BYTES), dtype=np.uint8)
        descriptors += [_flipped(rng, looks, config.own_flip_ratio), fresh]
        surfaces.append(np.full(len(own), facade))
    everything = np.concatenate(points)
    return Scene(
        ids=np.arange(1, len(everything) + 1, dtype=np.uint64),
        points=everything,
        normals=np.tile([0.0, -1.0, 0.0], (len(everything), 1)),
        surfaces=np.concatenate(surfaces),
        descriptors=np.concatenate(descriptors),
    )


def _window_looks(rng: np.random.Generator, config: StreetConfig, windows: int) -> Bytes:
    """(windows * elements, 32): what all façades have in common."""
    looks = rng.integers(0, 256, (config.elements, DESCRIPTOR_BYTES), dtype=np.uint8)
    return _flipped(rng, np.tile(looks, (windows, 1)), config.place_flip_ratio)


def _unique_points(rng: np.random.Generator, config: StreetConfig) -> Floats:
    """On and up to 1.5 m before the façade."""
    size = config.width, 1.5, config.floors * config.pitch[1]
    points: Floats = rng.random((config.unique, 3)) * size * np.array([1.0, -1.0, 1.0])
    return points


def _flipped(rng: np.random.Generator, rows: Bytes, ratio: float) -> Bytes:
    flips = rng.random((*rows.shape, 8)) < ratio
    return rows ^ np.packbits(flips, axis=-1)[..., 0]


def _along(rng: np.random.Generator, drone: int, config: StreetConfig) -> Trajectory:
    """Two passes before a façade at different heights, looking at it, a little to the sides."""
    facade, turn = divmod(drone, config.drones_per_facade)
    left = (1.0 - config.coverage) * turn / max(config.drones_per_facade - 1, 1)
    count, height = config.keyframes, config.floors * config.pitch[1]
    passes = np.arange(count) * 2 // count
    share = (np.arange(count) * 2 / count) % 1.0
    share = np.where(passes == 0, share, 1.0 - share)
    x = facade * (config.width + config.gap) + config.width * (left + config.coverage * share)
    z = height * (0.3 + 0.4 * passes)
    centres = np.column_stack([x, np.full(count, -config.distance), z])
    centres += 0.5 * rng.normal(size=centres.shape)
    targets = centres + np.array([0.0, config.distance, 0.0])
    targets[:, [0, 2]] += 1.5 * rng.normal(size=(count, 2))
    return look_at(centres, targets, np.array([0.0, 0.0, 1.0]))


def _name(drone: int) -> MapName:
    robot = f'drone{drone:02d}'
    return MapName(f'{robot}/0001', robot, stamp_ns=drone + 1, frame_id=f'{robot}/map')
