# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A merge that goes on from the last one: its landmarks as the start, its factor as the matrix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.factor import Carried, Change, Factor
from mapmerge_ros.fusion.joint.replaced import Member, change
from mapmerge_ros.fusion.joint.start import mean_of_members
from mapmerge_ros.geometry import align_segments

HIGHEST_PRICE = 1.0
"""Steps of the merge that a change of the old factor may cost: it saves two or three."""


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
    matrix: Carried | None
    """Factor of its Gauss-Newton matrix; None where that would take too much memory"""
    cost: JointCost | None = None
    """Of its shared landmarks, where the factor was made at its optimum"""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where a merge begins, and an old matrix to begin with."""

    points: Floats
    """(tracks, 3)"""
    matrix: Carried | None
    """None where there are landmarks that it knows nothing of"""


def resume(cost: JointCost, members: Members, last: Resumable) -> Start | None:
    """
    Start from the last merge; None where that does not determine the frame of some sub-map.

    Landmarks that are new lie where sub-maps see them that the others place.
    """
    before = _before(members, last.members, cost.count)
    points = np.full((cost.count, 3), np.nan)
    known = before >= 0
    points[known] = last.points[before[known]]
    if known.all():
        return Start(points, last.matrix and _carried(cost, members, points, before, last))
    while not known.all():
        weights = np.where(known[cost.tracks], cost.weights, 0.0)
        placed = align_segments(
            np.where(known[cost.tracks, None], points[cost.tracks], 0.0),
            cost.points_map,
            cost.segments,
            cost.gauges,
            weights,
        )
        sure = placed.determined[cost.segments.owners]
        seen = np.bincount(cost.tracks, weights=sure, minlength=cost.count) > 0
        if not (seen & ~known).any():
            return None
        means = mean_of_members(cost, placed.S_target_source, sure)
        points[seen & ~known] = means[seen & ~known]
        known |= seen
    return Start(points, None)


def _carried(
    cost: JointCost, members: Members, points: Floats, before: Ints, last: Resumable
) -> Carried:
    """Factor of the last merge for landmarks that had these numbers in it."""
    assert last.matrix is not None
    factor, numbers = last.matrix.factor, last.matrix.numbers[before]
    rows = {name: k for k, name in enumerate(last.members.map_ids)}
    if last.cost is None or rows.keys() != set(members.map_ids):
        return Carried(factor, numbers)
    pairs: list[tuple[Member, Member]] = []
    for k, name in enumerate(members.map_ids):
        old = Member(last.cost, rows[name], last.points, last.matrix.numbers)
        pairs.append((old, Member(cost, k, points, numbers)))
    # The noise is pooled: a new revision of one sub-map changes what all of them count.
    scale = float(np.median([new.weight / old.weight for old, new in pairs]))
    changed = [(old, new) for old, new in pairs if not new.counts_as(old, scale)]
    found = _change(factor, *changed[0], scale) if len(changed) == 1 else None
    return Carried(factor, numbers, found, scale)


def _change(factor: Factor, old: Member, new: Member, scale: float) -> Change | None:
    """
    What it does to the factor that one sub-map was replaced; None where that does not pay.

    Of several, how they bear on each other would have to be known; with each for itself it takes a
    step less at best, which is what it costs.
    """
    if old.price_in_steps(factor.fronts) > HIGHEST_PRICE:
        return None
    try:
        return change(factor, old, new, scale)
    except (DegenerateGeometry, np.linalg.LinAlgError):
        return None  # the merge says what is wrong, or gets on with the old factor


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
