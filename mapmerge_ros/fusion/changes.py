# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What one sub-map has elsewhere than the others: found in a merge, told, and taken out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.honest import Examination
from mapmerge_ros.fusion.names import Names
from mapmerge_ros.fusion.quadratic import Members
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import SubMap

MAX_UNLOCKED = 0.35
"""
Share of a sub-map's common landmarks that may be taken out of a merge.

More, and it is the map that is wrong, or the merge: an object that is half of what two maps have
in common cannot be told from the rest.
"""


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
    """(3,) from where the others have it to there"""
    covariance: Floats
    """(3, 3) of the displacement, global map units²"""
    p_value: float
    """of so significant a displacement if nothing moved"""
    object_id: int
    """Equal numbers: one object; 0: none"""
    kind: Kind

    @property
    def std(self) -> Floats:
        """(3,) of the displacement, global map units."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class Off:
    """Members of an examined merge that are off, and how sure that is."""

    members: Members
    at: Ints
    """(m,) rows of `members`"""
    covariances: Floats
    """(m, 3, 3) of the displacements, in the frame of the estimate"""
    p_values: Floats
    """(m,)"""
    objects: Ints
    """(m,) number of the object, 0 = none"""

    def __len__(self) -> int:
        return len(self.at)

    @property
    def believable(self) -> bool:
        """Whether so few members of every sub-map are off that the rest can be believed."""
        count = np.bincount(self.members.maps)
        off = np.bincount(self.members.maps[self.at], minlength=len(count))
        return bool((off <= MAX_UNLOCKED * count).all())


def find_off(
    found: Examination, members: Members, submaps: Sequence[SubMap], objects_before: int
) -> Off:
    """
    Collect what an examination says has moved or does not fit.

    Of two sub-maps that see an object at different places the newer one has it where it is now.
    A single landmark that does not fit is off. Only where the maps have errors that the textbook
    does not know, and ids say that it is the same point, it stays: there it is a bad track, which
    the full bundle would have to live with too.
    """
    at, sources, p_values, objects = list[Ints](), list[Floats](), list[float](), list[int]()
    if found.model is not None and found.tests is not None:
        for number, moved in enumerate(found.objects, objects_before + 1):
            at.append(_seen_by_newest(moved.members, members, submaps))
            count = len(moved.members)
            sources.append(np.broadcast_to(moved.covariance, (count, 3, 3)))
            p_values += [found.p_objects] * count
            objects += [number] * count
        in_objects = np.concatenate([np.zeros(0, np.int64), *at])
        alone = found.aside[~np.isin(members.tracks[found.aside], members.tracks[in_objects])]
        if not found.model.is_textbook:
            alone = alone[~_same_by_id(alone, members, submaps)]
        at.append(alone)
        sources.append(found.tests.covariance[alone])
        p_values += found.tests.p_value[alone].tolist()
        objects += [0] * len(alone)
    return Off(
        members,
        np.concatenate([np.zeros(0, np.int64), *at]),
        np.concatenate([np.zeros((0, 3, 3)), *sources]),
        np.array(p_values),
        np.array(objects, np.int64),
    )


def unlocked(association: Association, off: Off, rows: Sequence[Ints]) -> Association:
    """
    Give every member that is off a track of its own: the last ones, in the order of `off`.

    `rows` are, per sub-map, the rows of its shared landmarks among the compressed ones.
    """
    tracks = [own.copy() for own in association.tracks]
    for number, member in enumerate(off.at.tolist()):
        k = int(off.members.maps[member])
        tracks[k][rows[k][off.members.rows[member]]] = association.count + number
    return Association(
        tuple(tracks),
        association.count + len(off),
        np.append(association.nameless, np.zeros(len(off), bool)),
        tuple(
            np.where(own >= association.count, own + len(off), own)
            for own in association.catalogues
        ),
    )


def describe(
    off: Off,
    association: Association,
    submaps: Sequence[SubMap],
    rows: Sequence[Ints],
    points_global: Floats,
    S_global_estimate: Similarity,
    names: Names,
) -> tuple[Change, ...]:
    """
    Tell where every member that is off is, once it has been taken out of the merge.

    `association` is that before; `points_global` (n, 3) are the landmarks after.
    """
    linear = S_global_estimate.scale * S_global_estimate.rotation
    changes = []
    for number, member in enumerate(off.at.tolist()):
        k = int(off.members.maps[member])
        row = rows[k][off.members.rows[member]]
        position = points_global[association.count + number]
        changes.append(
            Change(
                map_id=submaps[k].map_id,
                revision=submaps[k].revision,
                landmark_id=int(submaps[k].compressed_ids[row]),
                global_id=int(names.ids[k][row]),
                position_global=position,
                displacement_global=position - points_global[association.tracks[k][row]],
                covariance=linear @ off.covariances[number] @ linear.T,
                p_value=float(off.p_values[number]),
                object_id=int(off.objects[number]),
                kind=Kind.MOVED if off.objects[number] else Kind.DOUBTFUL,
            )
        )
    return tuple(changes)


def _same_by_id(at: Ints, members: Members, submaps: Sequence[SubMap]) -> Mask:
    """Whether some other member of the same track (m,) is in the same id space."""
    spaces = np.array([submap.id_space for submap in submaps])[members.maps]
    same = (members.tracks[:, None] == members.tracks[at]) & (spaces[:, None] == spaces[at])
    return np.asarray((spaces[at] != '') & (same.sum(axis=0) > 1))


def _seen_by_newest(group: Ints, members: Members, submaps: Sequence[SubMap]) -> Ints:
    """
    Members (m,) that are displaced: those of the group, or their partners.

    If only one other sub-map has these landmarks, nobody can tell which of the two sees them
    where they no longer are: it is the older one.
    """
    same = members.tracks[:, None] == members.tracks[group]
    same[group, np.arange(len(group))] = False
    others = np.flatnonzero(same.any(axis=1))
    maps = np.unique(members.maps[others])
    if len(maps) != 1 or len(others) != len(group):
        return group
    own, other = submaps[int(members.maps[group[0]])], submaps[int(maps[0])]
    is_newer = (other.stamp_ns, other.map_id) > (own.stamp_ns, own.map_id)
    partners: Ints = np.argmax(same, axis=0)
    return partners if is_newer else group
