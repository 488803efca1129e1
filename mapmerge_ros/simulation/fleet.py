# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A fleet of drones over one yard, with everything that is true about it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints, Mask
from mapmerge_ros.bundle import Bundle, MapName, compress
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.simulation.adjust import MAX_ITERATIONS
from mapmerge_ros.simulation.drones import Sensing, fly, observe
from mapmerge_ros.simulation.moved import (
    MovedObject,
    TemporaryObject,
    brought,
    choose_objects,
    scene_at_visit,
    taken,
)
from mapmerge_ros.simulation.scene import Scene, yard_scene
from mapmerge_ros.simulation.session import Session
from mapmerge_ros.simulation.trajectory import Trajectory, lawn_mower
from mapmerge_ros.submap import SubMap

FLEET_ID_SPACE = 'fleet'
"""The id_space of maps whose landmark ids mean the same to all robots."""

VISIT_NS = 60_000_000_000
"""One drone lands every minute."""


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """Drones on a grid of cells, each in lanes over its own and a margin into the next."""

    drones: int = 4
    keyframes: int = 20
    """per drone"""
    landmarks: int = 180
    """in one cell of the grid; a drone sees about a third more, in the neighbours' cells"""
    cell: tuple[float, float] = (31.0, 23.0)
    """[m]; with the defaults below, neighbours see the outer 4 m of each other's cell"""
    path: tuple[float, float] = (28.0, 10.0)
    """Length of a drone's lanes and width between the outermost [m]."""
    lanes: int = 2
    altitude: float = 15.0
    """[m]"""
    sensing: Sensing = field(default_factory=Sensing)
    ids: Literal['fleet', 'private'] = 'fleet'
    """private: every robot numbers its landmarks by itself, matching is by descriptors"""
    descriptors: bool = True
    moved: int = 0
    """Objects of about ten landmarks moved between the visits of two drones."""
    moved_distance: float = 0.5
    """[m]"""
    added: int = 0
    """Objects that were not there at the first visits."""
    removed: int = 0
    """Objects that are no longer there at the last visits."""
    max_iterations: int = MAX_ITERATIONS
    """of each drone's adjustment; a small number stops it early"""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What the robots do not know; all in the world frame [m]."""

    scene: Scene
    """before anything was moved"""
    moved: tuple[MovedObject, ...]
    S_world_map: tuple[Similarity, ...]
    """per robot"""
    bundles: tuple[Bundle, ...]
    """per robot: true poses and points at its visit, in the rows of its own bundle"""
    landmark_ids: tuple[Ids, ...]
    """per robot: (n,) id in the scene of each of its points"""
    temporary: tuple[TemporaryObject, ...] = ()
    """first those that came, then those that went"""

    def points_world(self, landmark_ids: Ids) -> Floats:
        """Positions (k, 3) of landmarks of the scene, before anything was moved."""
        points: Floats = self.scene.points[np.searchsorted(self.scene.ids, landmark_ids)]
        return points

    def sees(self, landmark_ids: Ids) -> Mask:
        """Which robot has which of the given landmarks, (robots, k)."""
        return np.array([np.isin(landmark_ids, own) for own in self.landmark_ids])


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """The maps that the robots made, and the truth beside them."""

    bundles: tuple[Bundle, ...]
    names: tuple[MapName, ...]
    truth: Truth

    def shared_rows(self, robot: int) -> Ints:
        """Rows of the points of one robot that at least one other robot has too."""
        ids = self.truth.landmark_ids[robot]
        return np.flatnonzero(self.truth.sees(ids).sum(axis=0) >= 2)

    def submaps(self, *, catalogue: bool = True) -> tuple[SubMap, ...]:
        """Every map compressed to the landmarks that it shares with others."""
        return tuple(
            compress(bundle, name, bundle.point_ids[self.shared_rows(k)], catalogue=catalogue)
            for k, (bundle, name) in enumerate(zip(self.bundles, self.names, strict=True))
        )


def simulate_fleet(config: FleetConfig | None = None, seed: int = 0) -> Fleet:
    """
    Fly the drones one after the other; the same seed gives the same fleet.

    Raises
    ------
    SimulationError
        A drone sees too little, or too few objects can be moved.
    AdjustmentError
        pycolmap is missing, or a map could not be adjusted.

    """
    config = config or FleetConfig()
    site, paths, objects, *robots = np.random.default_rng(seed).spawn(3 + config.drones)
    scene = _yard(site, config)
    trajectories = _trajectories(paths, config)
    moved, temporary = _changes(objects, scene, trajectories, config)
    sessions = [
        fly(
            rng,
            scene_at_visit(scene, moved, visit, temporary),
            trajectory,
            config.sensing,
            descriptors=config.descriptors,
            private_ids=config.ids == 'private',
            max_iterations=config.max_iterations,
        )
        for visit, (rng, trajectory) in enumerate(zip(robots, trajectories, strict=True))
    ]
    return Fleet(
        bundles=tuple(session.bundle for session in sessions),
        names=tuple(_name(visit, config) for visit in range(config.drones)),
        truth=_truth(scene, moved, temporary, sessions),
    )


def _grid(drones: int) -> Ints:
    """Cell (column, row) of each drone, in the order of a snake: neighbours in time meet."""
    columns = int(np.ceil(np.sqrt(drones)))
    row, column = np.divmod(np.arange(drones), columns)
    return np.column_stack([np.where(row % 2 == 0, column, columns - 1 - column), row])


def _yard(rng: np.random.Generator, config: FleetConfig) -> Scene:
    # Half a cell of margin: the outermost drones too look over the edge of their cell.
    cells = _grid(config.drones).max(axis=0) + 2
    width, depth = cells * config.cell
    return yard_scene(
        rng,
        int(config.landmarks * cells.prod()),
        (float(width), float(depth)),
        houses=2 * int(cells.prod()),
    )


def _trajectories(rng: np.random.Generator, config: FleetConfig) -> list[Trajectory]:
    places = _grid(config.drones).astype(np.float64)
    centres = (places - places.max(axis=0) / 2.0) * config.cell
    return [
        lawn_mower(
            rng,
            np.append(centre, config.altitude),
            config.path,
            config.keyframes,
            lanes=config.lanes,
        )
        for centre in centres
    ]


def _changes(
    rng: np.random.Generator, scene: Scene, trajectories: list[Trajectory], config: FleetConfig
) -> tuple[tuple[MovedObject, ...], tuple[TemporaryObject, ...]]:
    moved, brought_end = config.moved, config.moved + config.added
    count = brought_end + config.removed
    if not count:
        return (), ()
    seen = [observe(rng, scene, path, config.sensing).point_ids for path in trajectories]
    table = np.array([np.isin(scene.ids, ids) for ids in seen])
    chosen = choose_objects(rng, scene, table, count, config.moved_distance)
    came = [brought(each, config.drones) for each in chosen[moved:brought_end]]
    return chosen[:moved], (*came, *(taken(each) for each in chosen[brought_end:]))


def _name(visit: int, config: FleetConfig) -> MapName:
    robot = f'drone{visit:0{len(str(config.drones - 1))}d}'
    return MapName(
        map_id=f'{robot}/0001',
        robot_id=robot,
        stamp_ns=(visit + 1) * VISIT_NS,
        frame_id=f'{robot}/map',
        id_space=FLEET_ID_SPACE if config.ids == 'fleet' else '',
    )


def _truth(
    scene: Scene,
    moved: tuple[MovedObject, ...],
    temporary: tuple[TemporaryObject, ...],
    sessions: list[Session],
) -> Truth:
    return Truth(
        scene=scene,
        moved=moved,
        temporary=temporary,
        S_world_map=tuple(session.S_world_map for session in sessions),
        bundles=tuple(session.truth for session in sessions),
        landmark_ids=tuple(session.landmark_ids for session in sessions),
    )
