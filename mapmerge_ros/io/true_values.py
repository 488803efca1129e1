# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What is true about a simulated recording."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, frozen
from mapmerge_ros.geometry import Similarity


@dataclass(frozen=True, slots=True, eq=False)
class TrueMap:
    """One robot's map and where it really is."""

    map_id: str
    robot_id: str
    S_world_map: Similarity
    own_ids: Ids
    """(n,) ids that the robot gave its landmarks; empty where they are the true ids"""
    true_ids: Ids
    """(n,) which landmark of the scene each of them is"""

    def __post_init__(self) -> None:
        set_, count = object.__setattr__, len(self.own_ids)
        set_(self, 'own_ids', frozen('own_ids', self.own_ids, np.uint64, (None,)))
        set_(self, 'true_ids', frozen('true_ids', self.true_ids, np.uint64, (count,)))


@dataclass(frozen=True, slots=True, eq=False)
class TrueMove:
    """Landmarks that were displaced together, and the maps that were made afterwards."""

    landmark_ids: Ids
    """(k,) in the scene"""
    map_ids: tuple[str, ...]
    displacement_world: Floats
    """(3,) [m]"""

    def __post_init__(self) -> None:
        ids = frozen('landmarks', self.landmark_ids, np.uint64, (None,))
        shift = frozen('displacement', self.displacement_world, float, (3,))
        object.__setattr__(self, 'landmark_ids', ids)
        object.__setattr__(self, 'displacement_world', shift)


@dataclass(frozen=True, slots=True, eq=False)
class TrueStay:
    """Landmarks that were there only while some of the maps were made."""

    landmark_ids: Ids
    """(k,) in the scene"""
    map_ids: tuple[str, ...]

    def __post_init__(self) -> None:
        ids = frozen('landmarks', self.landmark_ids, np.uint64, (None,))
        object.__setattr__(self, 'landmark_ids', ids)


@dataclass(frozen=True, slots=True, eq=False)
class RecordingTruth:
    """What the robots of a recording do not know; the world frame is metric."""

    landmark_ids: Ids
    """(n,)"""
    points_world: Floats
    """(n, 3) [m], before anything was moved"""
    maps: tuple[TrueMap, ...]
    moved: tuple[TrueMove, ...] = ()
    temporary: tuple[TrueStay, ...] = ()

    def __post_init__(self) -> None:
        ids = frozen('landmarks.ids', self.landmark_ids, np.uint64, (None,))
        points = frozen('landmarks.points', self.points_world, float, (len(ids), 3))
        object.__setattr__(self, 'landmark_ids', ids)
        object.__setattr__(self, 'points_world', points)
