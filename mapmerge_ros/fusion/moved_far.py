# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
What moved so far that its ids contradict all other landmarks.

Such ids are parted before the merge (`overlap`), so the merge is right without them and no test of
it sees them. Where they are is read from the merged map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse.csgraph
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import cKDTree
from scipy.spatial.distance import squareform

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.association.align_pair import variances
from mapmerge_ros.distributions import chi2_tail
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.changes import Change, Kind
from mapmerge_ros.fusion.names import Names
from mapmerge_ros.fusion.outgoing import Merged
from mapmerge_ros.fusion.overlap import Link
from mapmerge_ros.submap import SubMap

MIN_MEMBERS = 3
"""Neighbours that moved as one, from which it is an object: wrong ids go in all directions."""

REACH = 3.0
"""Distance of neighbours, over that of a landmark's third nearest in its map (median)."""

RIGID, NOISE_STDS = 0.1, 4.0
"""Share of its own by which the distance of two landmarks may change (maps bend), and noise."""

ALIKE = 0.5
"""Share of a displacement by which neighbours may differ (an object turns)."""

LEAST_SQUARE = 40.0
"""χ²(3) from which a landmark is elsewhere: a track may be parted because of another sub-map."""


@dataclass(frozen=True, slots=True, eq=False)
class _Member:
    """One sub-map's landmark of a track that was parted."""

    slot: int
    """Sub-map of the group"""
    row: int
    """among its compressed landmarks"""
    part: int
    """Track that it is in now"""
    position_global: Floats
    variance: float
    """of a coordinate, the rest of its map held still [global map units²]"""


@dataclass(frozen=True, slots=True, eq=False)
class _Displaced:
    member: _Member
    track: int
    """that was parted"""
    displacement_global: Floats
    variance: float
    """of a coordinate of that"""
    sense: float
    """1: the displacement is that in time; -1: the sub-map has it where it was"""

    @property
    def square(self) -> float:
        """Displacement over its uncertainty, χ²(3) if there is none."""
        return float(np.sum(self.displacement_global**2)) / self.variance

    @property
    def shift_global(self) -> Floats:
        """Where it went (3,)."""
        return self.sense * self.displacement_global

    @property
    def start_global(self) -> Floats:
        """Where it was (3,)."""
        to = self.member.position_global
        return to - self.displacement_global if self.sense > 0.0 else to


def with_moved_far(
    group: Sequence[int],
    merged: Merged,
    submaps: Sequence[SubMap],
    joined: Association,
    parted: Association,
    links: Sequence[Link],
) -> Merged:
    """
    Tell with a merged group what is elsewhere by more than its merge could believe.

    `joined` and `parted` are the associations of all `submaps` before and after contradicting ids
    were parted. Neighbours that moved as one, whichever sub-maps have them, are one object, the
    same as a known one that moved alike. Elsewhere is who is not where most
    sub-maps have a landmark, or where the newest has it if they are as many.
    """
    # A pair that is no link contradicts as a whole, and says nothing about single landmarks.
    contradicted = [
        link.contradicting
        for link in links
        if link.S_a_b is not None and {link.a, link.b} <= set(group)
    ]
    if not any(len(tracks) for tracks in contradicted):
        return merged
    changes = _changes(
        [submaps[k] for k in group],
        merged,
        [joined.tracks[k] for k in group],
        [parted.tracks[k] for k in group],
        np.unique(np.concatenate(contradicted)),
    )
    component = replace(merged.component, changes=(*merged.component.changes, *changes))
    return replace(merged, component=component)


def _changes(
    submaps: Sequence[SubMap],
    merged: Merged,
    before: Sequence[Ints],
    after: Sequence[Ints],
    contradicted: Ints,
) -> list[Change]:
    S_global_maps, names, known = (
        merged.S_global_maps,
        merged.component.names,
        merged.component.changes,
    )
    by_track: dict[int, list[_Member]] = {}
    for slot, (submap, S_global_map) in enumerate(zip(submaps, S_global_maps, strict=True)):
        rows = np.flatnonzero(np.isin(before[slot], contradicted))
        spread = S_global_map.scale**2 * variances(submap)[rows]
        places = S_global_map.apply(submap.compressed_points[rows])
        for row, place, variance in zip(rows.tolist(), places, spread.tolist(), strict=True):
            by_track.setdefault(int(before[slot][row]), []).append(
                _Member(slot, row, int(after[slot][row]), place, variance)
            )
    displaced = [
        each
        for track, members in sorted(by_track.items())
        for each in _displaced(track, members, submaps)
        if each.square >= LEAST_SQUARE
    ]
    reach = max(
        _reach(S_global_maps[slot].apply(submaps[slot].compressed_points))
        for slot in {each.member.slot for each in displaced} | {0}
    )
    changes, number = list[Change](), max((each.object_id for each in known), default=0)
    for group in _moved_as_one(displaced, reach):
        told = 0
        if len({each.track for each in group}) >= MIN_MEMBERS:
            told = _same_object(group, known, reach) or number + 1
            number = max(number, told)
        changes += _told(group, submaps, names, told)
    return changes


def _displaced(
    track: int, members: Sequence[_Member], submaps: Sequence[SubMap]
) -> list[_Displaced]:
    """Members that are not where most, or the newest, have the landmark."""
    parts: dict[int, list[_Member]] = {}
    for member in members:
        parts.setdefault(member.part, []).append(member)
    newest = {
        number: max((submaps[x.slot].stamp_ns, submaps[x.slot].map_id) for x in part)
        for number, part in parts.items()
    }
    number, current = max(parts.items(), key=lambda item: (len(item[1]), newest[item[0]]))
    place = np.mean([x.position_global for x in current], axis=0)
    variance = float(np.mean([x.variance for x in current])) / len(current)
    return [
        _Displaced(
            x,
            track,
            x.position_global - place,
            x.variance + variance,
            1.0 if newest[x.part] > newest[number] else -1.0,
        )
        for other, part in sorted(parts.items())
        if other != number
        for x in part
    ]


def _reach(points_global: Floats) -> float:
    count = min(4, len(points_global))
    distances = np.asarray(cKDTree(points_global).query(points_global, count)[0])
    return REACH * float(np.median(distances.reshape(len(points_global), -1)[:, -1]))


def _moved_as_one(own: Sequence[_Displaced], reach: float) -> list[list[_Displaced]]:
    """
    Groups of neighbours that went nearly the same way and stayed as far from each other.

    Each with all others of its group: along a chain of neighbours wrong ids find each other, too.
    """
    if not own:
        return []
    before = np.array([x.start_global for x in own])
    shifts = np.array([x.shift_global for x in own])
    variance = np.array([x.variance for x in own])
    apart, apart_after, differ = (
        np.linalg.norm(places[:, None] - places, axis=2)
        for places in (before, before + shifts, shifts)
    )
    noise = NOISE_STDS * np.sqrt(variance[:, None] + variance)
    lengths = np.linalg.norm(shifts, axis=1)
    allowed = ALIKE * np.minimum(lengths[:, None], lengths) + np.sqrt(3.0) * noise
    unlike = np.maximum(np.abs(apart_after - apart) / (RIGID * apart + noise), differ / allowed)
    chains = _chained((unlike <= 1.0) & (apart <= reach))
    return [
        [own[chain[k]] for k in part]
        for chain in chains
        for part in _all_with_all(unlike[np.ix_(chain, chain)])
    ]


def _chained(related: Mask) -> list[Ints]:
    """Parts of a graph (n, n)."""
    labels = scipy.sparse.csgraph.connected_components(related, directed=False)[1]
    return [np.flatnonzero(labels == label) for label in np.unique(labels)]


def _all_with_all(unlike: Floats) -> list[Ints]:
    """Groups of which no two are unlike (n, n) by more than one, the most alike first."""
    if len(unlike) == 1:
        return [np.zeros(1, np.int64)]
    labels = fcluster(linkage(squareform(unlike, checks=False), 'complete'), 1.0, 'distance')
    return [np.flatnonzero(labels == label) for label in np.unique(labels)]


def _same_object(group: Sequence[_Displaced], known: Sequence[Change], reach: float) -> int:
    """Number of the known object that the group belongs to; 0: none."""
    places = np.array(
        [place for x in group for place in (x.start_global, x.start_global + x.shift_global)]
    )
    shift = np.mean([x.shift_global for x in group], axis=0)
    for change in known:
        near = np.linalg.norm(places - change.position_global, axis=1).min() <= reach
        differ = min(
            float(np.linalg.norm(sign * change.displacement_global - shift))
            for sign in (1.0, -1.0)
        )
        if change.object_id and near and differ <= ALIKE * float(np.linalg.norm(shift)):
            return change.object_id
    return 0


def _told(
    group: Sequence[_Displaced], submaps: Sequence[SubMap], names: Names, object_id: int
) -> list[Change]:
    squares = [x.square for x in group]
    alone = np.atleast_1d(chi2_tail(np.array(squares), 3))
    together = float(chi2_tail(sum(squares), 3 * len(squares)))
    return [
        Change(
            map_id=submaps[x.member.slot].map_id,
            revision=submaps[x.member.slot].revision,
            landmark_id=int(submaps[x.member.slot].compressed_ids[x.member.row]),
            global_id=int(names.ids[x.member.slot][x.member.row]),
            position_global=x.member.position_global,
            displacement_global=x.displacement_global,
            covariance=x.variance * np.eye(3),
            p_value=together if object_id else float(p_value),
            object_id=object_id,
            kind=Kind.MOVED if object_id else Kind.DOUBTFUL,
        )
        for x, p_value in zip(group, alone, strict=True)
    ]
