# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Neighbouring landmarks of one sub-map that moved together, looked for before any fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.local import Sensitivity
from mapmerge_ros.fusion.motion import RigidMotion, rigid_motion
from mapmerge_ros.fusion.patches import RIGID, RIGID_FACTOR, TRANSLATION, Patch

SCANNED = ((6, (TRANSLATION,)), (12, (TRANSLATION, RIGID)))
"""
Landmarks that are tried as one object, and the motions that they are tried with.

Small objects stand out in six, large ones in twelve. Six have 18 coordinates: a rigid motion
would explain two bad tracks among them.
"""

LEAST_STATISTIC = 40.0
"""
χ²(3) of a common motion, one member free, from which it is an object, where noise is Gaussian.

p = 1e-8, for hundreds of overlapping neighbourhoods.
"""

LEAST_WITHOUT_LOUDEST = 20.0
"""
χ²(3) that must be left with the loudest fifth of the members free: two bad tracks are no object.
"""

MIN_MEMBERS = 5
"""Of which two are free in that test: EuRoC has bad tracks side by side, and others that fit."""

MIN_GAIN = 6.0
"""Rise of the statistic for which a landmark enters or leaves an object."""

MIN_TURNED, MIN_TURN = 6, 20.0
"""
Members from which a rotation has a say in who belongs, and χ²(3) that it must bring.

p = 1e-4: wrongly taken it lets a few more in.
"""

MAX_OBJECTS = 12
"""Beyond it, it is not objects that are wrong."""

GROSS = 4.0
"""
Times the statistic of the strongest neighbourhood from which one landmark alone is what is wrong.

One wrong id among right ones has 4 to 8, and pulls all about it along; the worst bad track of
real sets has 2.4 wherever something looks moved.
"""

MAX_GROSS = 12
"""Such landmarks at most: of more, the map is wrong."""


@dataclass(frozen=True, slots=True, eq=False)
class MovedObject:
    """Members of one sub-map with a common motion."""

    members: Ints
    """(m,) ascending"""
    statistic: float
    """
    χ²(3) of the common motion, the least with one member free.

    That of a rotation as well, χ²(6), is divided by `RIGID_FACTOR` to count the same.
    """
    without_loudest: float
    """The same with that fifth of the members, at least two, free that speaks for it most"""
    unbent: float
    """`without_loudest` with all quadratic bends of the sub-map free"""
    together: float
    """Share of its landmarks' nearest neighbours in this sub-map that belong to it as well"""
    extent: float
    """Distance of its landmarks from their mean, root mean square [global map units]"""
    motion: RigidMotion
    """Of this sub-map's landmarks, from where the others see them"""
    ambiguous: bool
    """All its landmarks are in two sub-maps only: which of the two moved cannot be told"""

    @property
    def displacement(self) -> Floats:
        """Displacement (3,) of its centre, global map units."""
        return self.motion.translation

    @property
    def covariance(self) -> Floats:
        """Covariance (3, 3) of `displacement`."""
        return self.motion.covariance[3:, 3:]


def find_objects(state: Sensitivity, points: Floats, least: float) -> tuple[MovedObject, ...]:
    """
    Objects one after the other, each unlocked before the next is looked for.

    What a single landmark that is wrong by far pulls along is none: it is unlocked first.

    `points` (n, 3) are the merged landmarks, `least` the statistic from which one counts.
    """
    found: list[MovedObject] = []
    gross = 0
    while len(found) < MAX_OBJECTS:
        seed = _strongest(state, points)
        if seed is None or seed[0] < least:
            break
        loudest = _loudest(state)
        is_gross = loudest[0] > GROSS * seed[0] and gross < MAX_GROSS
        moved = None if is_gross else grown(state, points, seed[1], least / LEAST_STATISTIC)
        if not (is_gross or (moved and moved.statistic >= least)):
            break
        try:
            state = state.unlock(moved.members if moved else np.array([loudest[1]]))
        except DegenerateGeometry:
            break  # without it, and those before, nothing says where its sub-map is
        gross += is_gross
        found += [moved] if moved else []
    return tuple(found)


def common_motion(state: Sensitivity, points: Floats, members: Ints) -> MovedObject:
    """Test of some members of one sub-map having one motion in common."""
    patch = _patch(state, points, members)
    return _tested(state, points, patch, patch.rows(members))


def grown(state: Sensitivity, points: Floats, seed: Ints, scale: float) -> MovedObject | None:
    """
    Object about some of its members; `scale`: statistics of unmoved landmarks over Gaussian ones.

    None if fewer than `MIN_MEMBERS` are left.
    """
    patch = _patch(state, points, seed)
    inside = _settled(patch, patch.rows(seed), TRANSLATION, scale)
    value = patch.statistic(inside, TRANSLATION) + MIN_TURN * scale
    # What turns about its own centre is two objects for a translation: try from the seed, too.
    for start in (inside, patch.rows(seed)):
        if len(start) >= MIN_TURNED:
            turned = _settled(patch, start, RIGID, scale)
            if patch.statistic(turned, RIGID) > value:
                inside, value = turned, patch.statistic(turned, RIGID)
    return _tested(state, points, patch, inside) if len(inside) >= MIN_MEMBERS else None


def released(state: Sensitivity, points: Floats, moved: MovedObject, scale: float) -> MovedObject:
    """
    Give back the member of a smallest object that moves otherwise: there pruning had to stop.

    It made four landmarks an object, and would be told, and taken out of the merge, with them.
    """
    if len(moved.members) != MIN_MEMBERS:
        return moved
    patch = _patch(state, points, moved.members)
    inside = patch.rows(moved.members)
    less = patch.with_one_less(inside, TRANSLATION)
    at = int(np.argmax(less))
    if less[at] < patch.statistic(inside, TRANSLATION) + MIN_GAIN * scale:
        return moved
    return _tested(state, points, patch, np.delete(inside, at))


def _patch(state: Sensitivity, points: Floats, members: Ints) -> Patch:
    return Patch.of_map(state, points, int(state.members.maps[members[0]]))


def _strongest(state: Sensitivity, points: Floats) -> tuple[float, Ints] | None:
    """Strongest neighbourhood of all sub-maps."""
    best: tuple[float, Ints] | None = None
    for k in range(len(state.within)):
        patch = Patch.of_map(state, points, k)
        for count, motions in SCANNED:
            if len(patch) < 2 * count:  # of which the rest must say where the map is
                continue
            statistics, rows = patch.neighbourhoods(count, motions)
            for motion, each in zip(motions, statistics, strict=True):
                at = int(np.argmax(each))
                statistic = float(each[at]) / _factor(motion)
                if best is None or statistic > best[0]:
                    best = statistic, patch.members[np.sort(rows[at])]
    return best


def _loudest(state: Sensitivity) -> tuple[float, int]:
    """Statistic of the landmark that says most by itself, and which member that is."""
    tests = state.tests()
    statistics = np.where(tests.distinct, tests.statistic, 0.0)
    at = int(np.argmax(statistics))
    return float(statistics[at]), at


def _factor(motion: int) -> float:
    return RIGID_FACTOR if motion == RIGID else 1.0


def _settled(patch: Patch, inside: Ints, motion: int, scale: float) -> Ints:
    """Add and drop the neighbour that raises the statistic most, until none does."""
    best = patch.statistic(inside, motion)
    for _ in range(2 * len(patch)):
        near = _around(patch, inside)
        more = patch.with_one_more(inside, near, motion)
        less = patch.with_one_less(inside, motion) if len(inside) > MIN_MEMBERS else np.zeros(0)
        values = np.concatenate([more, less, [-np.inf]])
        at = int(np.argmax(values))
        # one that stays inside may cost a little, one that enters must bring something
        if values[at] < best + MIN_GAIN * scale or len(inside) > len(patch) // 2:
            break
        dropped = np.delete(inside, at - len(more)) if at >= len(more) else inside
        inside = np.sort(np.append(inside, near[at])) if at < len(more) else dropped
        best = values[at]
    return inside


def _around(patch: Patch, inside: Ints) -> Ints:
    """Rows outside that are as near to one inside as those are to each other."""
    outside = np.setdiff1d(np.arange(len(patch)), inside)
    tree = cKDTree(patch.points[inside])
    reach = 2.0 * np.asarray(tree.query(patch.points[inside], 2)[0])[:, 1].max()
    return np.asarray(outside[tree.query(patch.points[outside])[0] <= reach])


def _tested(state: Sensitivity, points: Floats, patch: Patch, inside: Ints) -> MovedObject:
    motions = (TRANSLATION, RIGID) if len(inside) >= MIN_TURNED else (TRANSLATION,)
    members = patch.members[inside]
    views = np.bincount(state.members.tracks)
    here = patch.points[inside]
    unbent = patch.unbent()
    return MovedObject(
        members=members,
        statistic=max(patch.with_one_free(inside, each).min() / _factor(each) for each in motions),
        unbent=max(unbent.without_loudest(inside, each) / _factor(each) for each in motions),
        together=patch.togetherness(inside, MIN_MEMBERS - 1),
        without_loudest=max(
            patch.without_loudest(inside, each) / _factor(each) for each in motions
        ),
        extent=float(np.sqrt(3.0 * np.mean((here - here.mean(axis=0)) ** 2))),
        motion=rigid_motion(state, points, members),
        ambiguous=bool((views[state.members.tracks[members]] == 2).all()),
    )
