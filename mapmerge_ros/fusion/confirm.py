# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Objects under the fitted covariance model: what it explains was no object."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.distributions import chi2_tail
from mapmerge_ros.fusion.contrasts import SMOOTH_RADII
from mapmerge_ros.fusion.covariance_model import CovarianceModel
from mapmerge_ros.fusion.local import Sensitivity
from mapmerge_ros.fusion.objects import (
    LEAST_STATISTIC,
    LEAST_WITHOUT_LOUDEST,
    MIN_MEMBERS,
    MovedObject,
    common_motion,
    find_objects,
    grown,
    released,
)
from mapmerge_ros.geometry import scene_radius

LEAST_CONFIRMED = 70.0
"""
χ²(3) from which an object stands under a model other than the textbook, × the mean of its tails.

What is left of warp has up to 56 (30 landmarks of Caliterra), twelve landmarks that moved by five
of their standard deviations 89 and more there and on EuRoC.
"""

BORDER = 1.45
"""
Share of the neighbours of its landmarks that a larger object may lack, × the root of its size.

Twelve at one place have 0.58 of theirs inside at least, 27 have 0.72 (19 of 20 draws). What was
picked from landmarks that did not move has less: 0.38 (30 of Brighton), 0.36 to 0.63 (13 to 27 of
pairs of Caliterra).
"""

BEYOND_BENDS, MOSTLY = 7.0, 0.65
"""
Displacement [ω] from which what is smaller than a bend need not be of one piece, and how much of
it there has to be, of what `BORDER` asks for: at the rim of a map twelve neighbours are not
always; such have 0.71 to 0.9 of it.

Two maps differ by 4.8 ω (1 in 100), what was picked by 5.8, or by 9.1 (15 of 150 landmarks of
Boruszyn, with 0.53 of it at most).
"""

COMPACT_RADII = 0.3
"""Extent [scene radii] up to which nobody asks; those of Caliterra had 0.34 to 0.61."""


def confirmed(
    state: Sensitivity,
    points: Floats,
    suspects: tuple[MovedObject, ...],
    model: CovarianceModel,
) -> tuple[MovedObject, ...]:
    """
    Suspects that the model does not explain, their members chosen anew, and what it shows more.

    Each is tested with all others unlocked. `points` (tracks, 3) are the merged landmarks.
    """
    kept, radius = list[MovedObject](), scene_radius(points)
    for at, moved in enumerate(suspects):
        others = [other.members for other in (*kept, *suspects[at + 1 :])]
        rest = state.unlock(np.concatenate(others)) if others else state
        seen = moved.members[rest.testable()[moved.members]]
        # Who belongs is chosen anew only afterwards, or it gathers the bad tracks nearby.
        if len(seen) >= MIN_MEMBERS and _stands(common_motion(rest, points, seen), model, radius):
            again = grown(rest, points, seen, model.tails.mean)
            kept += [again] if again and _stands(again, model, radius) else []
    rest = state.unlock(members_of(kept)) if kept else state
    found = find_objects(rest, points, LEAST_STATISTIC * model.tails.mean)
    return (*kept, *(moved for moved in found if _stands(moved, model, radius)))


def without_bystanders(
    state: Sensitivity,
    points: Floats,
    objects: tuple[MovedObject, ...],
    model: CovarianceModel,
) -> tuple[MovedObject, ...]:
    """Objects that stand, less the one landmark that was needed for their number (`released`)."""
    kept = list(objects)
    for at, moved in enumerate(objects):
        others = members_of([*kept[:at], *kept[at + 1 :]])
        rest = state.unlock(others) if len(others) else state
        if rest.testable()[moved.members].all():
            kept[at] = released(rest, points, moved, model.tails.mean)
    return tuple(kept)


def members_of(objects: tuple[MovedObject, ...] | list[MovedObject]) -> Ints:
    """Members of all objects."""
    return np.concatenate([np.zeros(0, np.int64), *(moved.members for moved in objects)])


def p_objects(objects: tuple[MovedObject, ...], model: CovarianceModel) -> float:
    """Probability that the strongest of the objects is an error under the model."""
    strongest = max((moved.statistic for moved in objects), default=0.0)
    return float(chi2_tail(strongest / model.tails.mean, 3))


def _stands(moved: MovedObject, model: CovarianceModel, radius: float) -> bool:
    scale = model.tails.mean
    least = LEAST_STATISTIC if model.is_textbook else LEAST_CONFIRMED
    if moved.statistic < least * scale or moved.without_loudest < LEAST_WITHOUT_LOUDEST * scale:
        return False
    if model.is_textbook or moved.extent <= COMPACT_RADII * radius:
        return True
    # Of one piece, or it was picked; and as large as the bends of a lens, it has to be no bend.
    usual = 1.0 - BORDER / np.sqrt(len(moved.members))
    is_scattered = moved.together < usual
    if moved.extent > SMOOTH_RADII * radius:
        return not is_scattered and moved.unbent >= least * scale
    distances = np.linalg.norm(moved.motion.of_members()[0], axis=1)
    is_far = float(np.median(distances)) >= BEYOND_BENDS * model.omega
    return not is_scattered or (is_far and moved.together >= MOSTLY * usual)
