# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Objects that someone moves, brings or takes away between the visits of two robots."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from mapmerge_ros.arrays import Floats, Ids, Ints, Mask, frozen
from mapmerge_ros.simulation.scene import Scene
from mapmerge_ros.simulation.session import SimulationError

LANDMARKS_PER_OBJECT = 10
"""A parked car, a pallet: some features each."""

SHARED_RATIO = 0.5
"""Of an object's landmarks, those that a robot must see before and another after the move."""


@dataclass(frozen=True, slots=True, eq=False)
class MovedObject:
    """Nearby landmarks that were displaced together."""

    landmark_ids: Ids
    """(k,) ids in the scene"""
    displacement_world: Floats
    """(3,) [m], horizontal"""
    first_visit_after: int
    """Number of the first robot that came after the move."""

    def __post_init__(self) -> None:
        ids = frozen('landmark_ids', self.landmark_ids, np.uint64, (None,))
        shift = frozen('displacement_world', self.displacement_world, float, (3,))
        object.__setattr__(self, 'landmark_ids', ids)
        object.__setattr__(self, 'displacement_world', shift)


@dataclass(frozen=True, slots=True, eq=False)
class TemporaryObject:
    """Nearby landmarks that are not always there."""

    landmark_ids: Ids
    """(k,) ids in the scene"""
    first_visit: int
    """Number of the first robot that finds it"""
    visit_after: int
    """Number of the first robot that no longer does"""

    def __post_init__(self) -> None:
        ids = frozen('landmark_ids', self.landmark_ids, np.uint64, (None,))
        object.__setattr__(self, 'landmark_ids', ids)

    def is_there(self, visit: int) -> bool:
        """Whether robot number `visit` finds it."""
        return self.first_visit <= visit < self.visit_after


def brought(moved: MovedObject, visits: int) -> TemporaryObject:
    """Return an object that comes when the other one is moved."""
    return TemporaryObject(moved.landmark_ids, moved.first_visit_after, visits)


def taken(moved: MovedObject) -> TemporaryObject:
    """Return an object that goes when the other one is moved."""
    return TemporaryObject(moved.landmark_ids, 0, moved.first_visit_after)


def choose_objects(
    rng: np.random.Generator, scene: Scene, seen: Mask, count: int, distance: float
) -> tuple[MovedObject, ...]:
    """
    Pick objects that robots see both before and after they are moved by `distance` [m].

    Parameters
    ----------
    seen
        (robots, n) which robot sees which landmark of the scene.

    Raises
    ------
    SimulationError
        Fewer than `count` such objects.

    """
    tree, used = cKDTree(scene.points), np.zeros(len(scene), np.bool_)
    objects: list[MovedObject] = []
    for seed in rng.permutation(np.flatnonzero(seen.sum(axis=0) >= 2)):
        if len(objects) == count:
            break
        near = np.asarray(tree.query(scene.points[seed], LANDMARKS_PER_OBJECT)[1])
        visit = _visit_between(rng, seen[:, near])
        if used[near].any() or visit is None:
            continue
        used[near] = True
        angle = rng.uniform(-np.pi, np.pi)
        shift = distance * np.array([np.cos(angle), np.sin(angle), 0.0])
        objects.append(MovedObject(np.sort(scene.ids[near]), shift, visit))
    if len(objects) < count:
        raise SimulationError(
            f'moved: {count} objects asked for (with those added and removed), the robots share '
            f'only {len(objects)}'
        )
    return tuple(objects)


def scene_at_visit(
    scene: Scene,
    objects: tuple[MovedObject, ...],
    visit: int,
    temporary: tuple[TemporaryObject, ...] = (),
) -> Scene:
    """Return the scene as robot number `visit` finds it."""
    for moved in objects:
        if visit >= moved.first_visit_after:
            rows = np.searchsorted(scene.ids, moved.landmark_ids)
            scene = scene.displaced(rows, moved.displacement_world)
    absent = [each.landmark_ids for each in temporary if not each.is_there(visit)]
    return scene.without(np.concatenate(absent)) if absent else scene


def _visit_between(rng: np.random.Generator, seen: Mask) -> int | None:
    """Visit before which an object can be moved so that both sides know it well."""
    knows: Ints = np.flatnonzero(seen.mean(axis=1) >= SHARED_RATIO)
    together = [
        later
        for earlier, later in pairwise(knows)
        if (seen[earlier] & seen[later]).mean() >= SHARED_RATIO
    ]
    return int(rng.choice(together)) if together else None
