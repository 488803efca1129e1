# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What an examined merge has that is off: found, and taken out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.changes import Off
from mapmerge_ros.fusion.confirm import members_of
from mapmerge_ros.fusion.examination import Examination
from mapmerge_ros.fusion.objects import MovedObject
from mapmerge_ros.fusion.quadratic import Members
from mapmerge_ros.submap import SubMap

MAX_UNLOCKED = 0.35
"""
Share of a sub-map's common landmarks that may be taken out of a merge.

More, and it is the map that is wrong, or the merge: an object that is half of what two maps have
in common cannot be told from the rest. Where only two have a landmark, both are concerned: of a
bent map, half of what is off seems to be its neighbours'.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Examined:
    """An examination with the way from its members to the landmarks of the sub-maps."""

    found: Examination
    association: Association
    rows: Sequence[Ints]
    """Per sub-map, rows of its shared landmarks among the compressed ones"""

    def off(
        self, at: Ints, displacements: Floats, covariances: Floats, p_values: Floats, objects: Ints
    ) -> Off:
        """Some members (m,), with their displacements (m, 3)."""
        assert self.found.tests is not None
        members = self.found.tests.members
        maps, inside = members.maps[at], members.rows[at]
        rows = np.array([self.rows[k][row] for k, row in zip(maps, inside, strict=True)], int)
        tracks = np.array(
            [self.association.tracks[k][row] for k, row in zip(maps, rows, strict=True)], int
        )
        views = np.bincount(members.tracks)[members.tracks[at]]
        everyone = np.bincount(members.tracks, weights=members.maps)[members.tracks[at]]
        return Off(
            maps=maps,
            rows=rows,
            tracks=tracks,
            partners=np.where(views == 2, everyone.astype(np.int64) - maps, -1),
            own_tracks=self.association.count + np.arange(len(at)),
            displacements_global=displacements,
            covariances_global=covariances,
            p_values=p_values,
            objects=objects,
        )


def find_off(examined: Examined, submaps: Sequence[SubMap], objects_before: int) -> Off | None:
    """
    Collect what an examination says has moved or does not fit; None if that is nobody.

    Of two sub-maps that see an object at different places the newer one has it where it is now.
    A single landmark that does not fit is off. Only where the maps have errors that the textbook
    does not know, and ids say that it is the same point, it stays: there it is a bad track, which
    the full bundle would have to live with too.
    """
    found, tests = examined.found, examined.found.tests
    if found.model is None or tests is None:
        return None
    members = tests.members
    moved = [_displaced(each, members, submaps) for each in found.objects]
    motions = [each.motion.of_members() for each in found.objects]
    explained = members.tracks[members_of(found.objects)]
    alone = found.aside[~np.isin(members.tracks[found.aside], explained)]
    if not found.model.is_textbook:
        alone = alone[~_same_by_id(alone, members, submaps)]
    sizes = [len(each.members) for each in found.objects]
    if not len(alone) + sum(sizes):
        return None
    return examined.off(
        np.concatenate([*(at for at, _ in moved), alone]),
        np.concatenate(
            [
                *(sign * by for (_, sign), (by, _) in zip(moved, motions, strict=True)),
                tests.displacement[alone],
            ]
        ),
        np.concatenate([*(covariance for _, covariance in motions), tests.covariance[alone]]),
        np.append(np.full(sum(sizes), found.p_objects), tests.p_value[alone]),
        np.append(
            np.repeat(objects_before + 1 + np.arange(len(sizes)), sizes), np.zeros_like(alone)
        ),
    )


def find_doubtful(examined: Examined) -> Off | None:
    """Single landmarks that are off beyond chance, and are merged nevertheless."""
    found, tests = examined.found, examined.found.tests
    if tests is None or not len(found.doubtful):
        return None
    at = found.doubtful
    return examined.off(
        at, tests.displacement[at], tests.covariance[at], tests.p_value[at], np.zeros_like(at)
    )


def too_much(taken_out: Sequence[Off], rows: Sequence[Ints]) -> Ints:
    """
    Sub-maps (indices) of which so much is off that the rest cannot be believed, most first.

    `rows` are those of the landmarks that were shared before the last of `taken_out`.
    """
    count = np.array([len(own) for own in rows], np.float64)
    concerned = [_concerned(off, len(rows)) for off in taken_out]
    share = np.sum(concerned, axis=0) / np.maximum(count + np.sum(concerned[:-1], axis=0), 1.0)
    return np.flatnonzero(share > MAX_UNLOCKED)[np.argsort(-share[share > MAX_UNLOCKED])]


def _concerned(off: Off, count: int) -> Ints:
    """How many landmarks that are off concern each sub-map (count,)."""
    both = np.concatenate([off.maps, off.partners[off.partners >= 0]])
    return np.bincount(both, minlength=count)


def unlocked(association: Association, off: Off) -> Association:
    """Give every landmark that is off a track of its own, after all others."""
    tracks = [own.copy() for own in association.tracks]
    for k in np.unique(off.maps):
        mine = off.maps == k
        tracks[k][off.rows[mine]] = off.own_tracks[mine]
    return Association(
        tuple(tracks),
        association.count + len(off),
        np.append(association.nameless, np.zeros(len(off), bool)),
        tuple(
            np.where(own >= association.count, own + len(off), own)
            for own in association.catalogues
        ),
    )


def _same_by_id(at: Ints, members: Members, submaps: Sequence[SubMap]) -> Mask:
    """Whether some other member of the same track (m,) is in the same id space."""
    spaces = np.array([submap.id_space for submap in submaps])[members.maps]
    same = (members.tracks[:, None] == members.tracks[at]) & (spaces[:, None] == spaces[at])
    return np.asarray((spaces[at] != '') & (same.sum(axis=0) > 1))


def _displaced(
    moved: MovedObject, members: Members, submaps: Sequence[SubMap]
) -> tuple[Ints, float]:
    """
    Members (m,) that are displaced, and the sign of the motion: the group, or their partners.

    If only one other sub-map has these landmarks, nobody can tell which of the two sees them
    where they no longer are: it is the older one.
    """
    group = moved.members
    same = members.tracks[:, None] == members.tracks[group]
    same[group, np.arange(len(group))] = False
    partners: Ints = np.argmax(same, axis=0)
    maps = np.unique(members.maps[partners])
    if not moved.ambiguous or len(maps) != 1:
        return group, 1.0
    own, other = submaps[int(members.maps[group[0]])], submaps[int(maps[0])]
    is_newer = (other.stamp_ns, other.map_id) > (own.stamp_ns, own.map_id)
    return (partners, -1.0) if is_newer else (group, 1.0)
