# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What one sub-map has elsewhere than the others, and how it is told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.names import Names
from mapmerge_ros.submap import SubMap


class Kind(IntEnum):
    """How sure a change is; the numbers are those of `mapmerge_msgs/Change`."""

    DOUBTFUL = 0
    """One landmark: a wrong match or a bad track is as likely as motion"""
    MOVED = 1
    """Together with its neighbours"""


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """A landmark that one sub-map has elsewhere than the others."""

    map_id: str
    revision: int
    landmark_id: int
    """the sub-map's own"""
    global_id: int
    """in the merged map"""
    position_global: Floats
    """(3,) where this sub-map has it"""
    displacement_global: Floats
    """(3,) from where the others have it to there; in an object by the motion of the whole"""
    covariance: Floats
    """(3, 3) of the displacement, global map units²"""
    p_value: float
    """of so significant a displacement if nothing moved"""
    object_id: int
    """Equal numbers: one object; 0: none"""
    kind: Kind
    merged: bool = False
    """Whether it is held equal to the others all the same: it may be one bad track of many"""

    @property
    def std(self) -> Floats:
        """(3,) of the displacement, global map units."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Off:
    """Landmarks of sub-maps that one examination of a merge found to be off."""

    maps: Ints
    """(m,) sub-map"""
    rows: Ints
    """(m,) row among its compressed landmarks"""
    tracks: Ints
    """(m,) track that held them; the others keep it"""
    partners: Ints
    """(m,) the only other sub-map that has it; -1: several have"""
    own_tracks: Ints
    """(m,) track of their own, once they are taken out of the merge"""
    displacements_global: Floats
    """(m, 3) from where the others have it"""
    covariances_global: Floats
    """(m, 3, 3) of those"""
    p_values: Floats
    """(m,)"""
    objects: Ints
    """(m,) number of the object, 0 = none"""

    def __len__(self) -> int:
        return len(self.maps)

    @property
    def singles(self) -> int:
        """How many of them do not fit, each by itself."""
        return int((self.objects == 0).sum())


def describe(
    off: Off, submaps: Sequence[SubMap], positions_global: Floats, names: Names, *, merged: bool
) -> tuple[Change, ...]:
    """Tell where the landmarks that are off (m,) are: their sub-map has them there (m, 3)."""
    return tuple(
        Change(
            map_id=submaps[k].map_id,
            revision=submaps[k].revision,
            landmark_id=int(submaps[k].compressed_ids[row]),
            global_id=int(names.ids[k][row]),
            position_global=positions_global[at],
            displacement_global=off.displacements_global[at],
            covariance=off.covariances_global[at],
            p_value=float(off.p_values[at]),
            object_id=int(off.objects[at]),
            kind=Kind.MOVED if off.objects[at] else Kind.DOUBTFUL,
            merged=merged,
        )
        for at, (k, row) in enumerate(zip(off.maps.tolist(), off.rows.tolist(), strict=True))
    )
