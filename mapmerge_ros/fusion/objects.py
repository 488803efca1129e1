# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Neighbouring landmarks of one sub-map that moved together, looked for before any fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion.local import Sensitivity

NEIGHBOURS = (6, 12)
"""Landmarks that are tried as one object: small ones stand out in six, large ones in twelve."""

LEAST_STATISTIC = 40.0
"""
Leave-one-out χ²(3) of a common motion from which it is an object, where noise is Gaussian.

p = 1e-8, for hundreds of overlapping neighbourhoods.
"""

LEAST_WITHOUT_LOUDEST = 20.0
"""
χ²(3) that must be left without the loudest fifth of the members: two bad tracks are no object.

Suspects of more than five landmarks on unchanged sets have up to 14, moved objects 26 and more.
"""

MIN_GAIN = 6.0
"""Rise of the statistic for which a landmark enters or leaves an object."""

MAX_OBJECTS = 12
"""Beyond it, it is not objects that are wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class MovedObject:
    """Members of one sub-map with a common displacement."""

    members: Ints
    """(m,) ascending"""
    statistic: float
    """χ²(3) of the common displacement, the least with one member left out"""
    without_loudest: float
    """The same with that fifth of the members left out that speaks for it most"""
    displacement: Floats
    """(3,) global map units, of this sub-map's landmarks from where the others see them"""
    covariance: Floats
    """(3, 3)"""


def find_objects(state: Sensitivity, points: Floats, least: float) -> tuple[MovedObject, ...]:
    """
    Objects one after the other, each unlocked before the next is looked for.

    `points` (n, 3) are the merged landmarks, `least` the statistic from which one counts.
    """
    found: list[MovedObject] = []
    while len(found) < MAX_OBJECTS:
        seed = _strongest(state, points)
        if seed is None or seed[0] < least:
            break
        moved = _grown(state, points, seed[1])
        if moved is None or moved.statistic < least:
            break
        found.append(moved)
        state = state.unlock(moved.members)
    return tuple(found)


def common_motion(state: Sensitivity, members: Ints) -> MovedObject:
    """Test of some members of one sub-map having one displacement in common."""
    score, blocks = _parts(state, members[None, :])
    covariance = np.linalg.inv(blocks[0].sum(axis=(0, 1)))
    return MovedObject(
        members,
        float(_leave_one_out(score, blocks)[0]),
        _without_loudest(state, members),
        covariance @ score[0].sum(axis=0),
        covariance,
    )


def neighbourhood_statistics(state: Sensitivity, points: Floats) -> list[tuple[Floats, Ints]]:
    """Leave-one-out statistics (c,) and members (c, m) of every neighbourhood, by sub-map."""
    testable = state.testable()
    every = []
    for k in range(len(state.within)):
        part = state.members.of_map(k)
        own = part.start + np.flatnonzero(testable[part])
        for count in NEIGHBOURS:
            if len(own) < 2 * count:  # of which the rest must say where the map is
                continue
            near = _nearest(points[state.members.tracks[own]], count)
            groups = np.sort(own[near], axis=1)
            every.append((_leave_one_out(*_parts(state, groups)), groups))
    return every


def _strongest(state: Sensitivity, points: Floats) -> tuple[float, Ints] | None:
    best: tuple[float, Ints] | None = None
    for statistics, groups in neighbourhood_statistics(state, points):
        at = int(np.argmax(statistics))
        if best is None or statistics[at] > best[0]:
            best = float(statistics[at]), groups[at]
    return best


def _grown(state: Sensitivity, points: Floats, seed: Ints) -> MovedObject | None:
    """Add and drop the neighbour that raises the statistic most, until none does."""
    members, part = seed, state.members.of_map(int(state.members.maps[seed[0]]))
    own = part.start + np.flatnonzero(state.testable()[part])
    best = _statistic(state, members)
    for _ in range(len(own)):
        near = _around(points[state.members.tracks], own, members)
        trials = [np.append(members, one) for one in near]
        trials += [np.delete(members, at) for at in range(len(members)) if len(members) > 3]
        values = [_statistic(state, np.sort(trial)) for trial in trials]
        at = int(np.argmax(values))
        # one that stays inside may cost a little, one that enters must bring something
        if values[at] < best + MIN_GAIN or len(members) > len(own) // 2:
            break
        members, best = np.sort(trials[at]), values[at]
    return common_motion(state, members) if len(members) >= 3 else None


def _around(points: Floats, own: Ints, members: Ints) -> Ints:
    """Members outside that are as near to one inside as those are to each other."""
    outside = np.setdiff1d(own, members)
    inside = points[members]
    reach = 2.0 * np.asarray(cKDTree(inside).query(inside, 2)[0])[:, 1].max()
    distances = np.asarray(cKDTree(inside).query(points[outside])[0])
    near = outside[distances <= reach]
    return np.asarray(near[np.argsort(distances[distances <= reach])][:12])


def _statistic(state: Sensitivity, members: Ints) -> float:
    score, blocks = _parts(state, members[None, :])
    total = score[0].sum(axis=0)
    return float(total @ np.linalg.solve(blocks[0].sum(axis=(0, 1)), total))


def _without_loudest(state: Sensitivity, members: Ints) -> float:
    """Statistic of the common motion without those, one in five, that speak for it most."""
    for _ in range(-(-len(members) // 5)):
        trials = [np.delete(members, at) for at in range(len(members))]
        members = trials[int(np.argmin([_statistic(state, trial) for trial in trials]))]
    return _statistic(state, members)


def _nearest(points: Floats, count: int) -> Ints:
    return np.asarray(cKDTree(points).query(points, count)[1], np.int64)


def _parts(state: Sensitivity, groups: Ints) -> tuple[Floats, Floats]:
    """Scores (c, m, 3) and blocks of J (c, m, m, 3, 3) of groups (c, m) within a sub-map."""
    k = int(state.members.maps[groups[0, 0]])
    rows = groups - state.members.of_map(k).start
    own = state.within[k]
    blocks = own.reshape(len(own) // 3, 3, -1, 3)
    return state.score[groups], blocks[rows[:, :, None], :, rows[:, None, :], :]


def _leave_one_out(score: Floats, blocks: Floats) -> Floats:
    """Least statistic (c,) of the common motion with any one member left out."""
    total, matrix = score.sum(axis=1), blocks.sum(axis=(1, 2))
    every = np.arange(score.shape[1])
    crossing = blocks.sum(axis=2)
    left = matrix[:, None] - crossing - crossing.swapaxes(-1, -2) + blocks[:, every, every]
    rest = total[:, None] - score
    solved = np.linalg.solve(left, rest[..., None])[..., 0]
    return np.asarray(np.einsum('cmi,cmi->cm', rest, solved).min(axis=1))
