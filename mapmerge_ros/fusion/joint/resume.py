# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A merge that goes on from the last one: its landmarks as the start, its factor as the matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.factor import Factor
from mapmerge_ros.fusion.joint.start import mean_of_members
from mapmerge_ros.geometry import align_segments


@dataclass(frozen=True, slots=True, eq=False)
class Members:
    """Which landmark of which sub-map each row of a `JointCost` is."""

    map_ids: tuple[str, ...]
    owners: Ints
    """(rows,) sub-map"""
    landmark_ids: Ids
    """(rows,)"""
    tracks: Ints
    """(rows,) its number in the merge"""

    @classmethod
    def of(cls, cost: JointCost, map_ids: Sequence[str], landmark_ids: Ids) -> Members:
        """Members of a cost; `landmark_ids` (rows,)."""
        return cls(tuple(map_ids), cost.segments.owners, landmark_ids, cost.tracks)


@dataclass(frozen=True, slots=True, eq=False)
class Resumable:
    """What a merge leaves to the next one."""

    members: Members
    points: Floats
    """(tracks, 3) where its landmarks came to lie"""
    factor: Factor | None
    """Of its Gauss-Newton matrix; None where that would take too much memory"""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where a merge begins, and an old matrix to begin with."""

    points: Floats
    """(tracks, 3)"""
    factor: Factor | None
    before: Ints
    """(tracks,) number in the factor; -1 for a landmark that is new"""

    def solve(self, right: Floats) -> Floats:
        """Old matrix' answer (3 tracks,); a landmark that it does not know has none."""
        assert self.factor is not None
        known = self.before >= 0
        old = np.zeros((self.factor.fronts.size // 3, 3))
        old[self.before[known]] = right.reshape(-1, 3)[known]
        answer = np.zeros((len(known), 3))
        answer[known] = self.factor.solve(old.ravel()).reshape(-1, 3)[self.before[known]]
        return answer.ravel()


def resume(cost: JointCost, members: Members, last: Resumable) -> Start | None:
    """
    Start from the last merge; None where that does not determine the frame of some sub-map.

    Landmarks that are new lie where their sub-maps see them, placed by all others.
    """
    before = _before(members, last.members, cost.count)
    points = np.zeros((cost.count, 3))
    known = before >= 0
    points[known] = last.points[before[known]]
    if known.all():
        return Start(points, last.factor, before)
    weights = np.where(known[cost.tracks], cost.weights, 0.0)
    if not (cost.segments.counts(weights > 0.0) > 0).all():
        return None
    placed = align_segments(
        points[cost.tracks], cost.points_map, cost.segments, cost.gauges, weights
    )
    if not placed.determined.all():
        return None
    means = mean_of_members(cost, placed.S_target_source)
    points[~known] = means[~known]
    # The old matrix says nothing of how new landmarks hang together with the others.
    return Start(points, None, before)


def _before(new: Members, old: Members, count: int) -> Ints:
    """Number (count,) that each landmark had, or -1: that of the member of its first sub-map."""
    codes = {map_id: code for code, map_id in enumerate({*new.map_ids, *old.map_ids})}
    maps, ids, tracks, is_new = (
        np.concatenate(parts)
        for parts in (
            [_codes(old, codes), _codes(new, codes)],
            [old.landmark_ids, new.landmark_ids],
            [old.tracks, new.tracks],
            [np.zeros(len(old.tracks), bool), np.ones(len(new.tracks), bool)],
        )
    )
    order = np.lexsort((is_new, ids, maps))
    low, high = order[:-1], order[1:]
    same = (maps[low] == maps[high]) & (ids[low] == ids[high]) & ~is_new[low] & is_new[high]
    low, high = low[same], high[same]
    before = np.full(count, -1)
    turn = np.argsort(-high, kind='stable')  # of several members, the first one stays
    before[tracks[high[turn]]] = tracks[low[turn]]
    # Two landmarks that were one cannot both be it.
    used, first = np.unique(before, return_index=True)
    twice = np.ones(count, bool)
    twice[first[used >= 0]] = False
    before[twice] = -1
    return before


def _codes(members: Members, codes: dict[str, int]) -> Ints:
    return np.array([codes[map_id] for map_id in members.map_ids])[members.owners]
