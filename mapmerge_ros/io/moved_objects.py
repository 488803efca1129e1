# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks that moved together, as one object with one motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.stats
from scipy.spatial.transform import Rotation

from mapmerge_ros.arrays import Floats
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion import Change
from mapmerge_ros.geometry import Gauge, align

TURNED_LEVEL = 1e-3
"""p-value below which a turn is told: it is one of many that are looked at."""

MIN_TO_TURN = 4
"""Landmarks: three have no redundancy to speak of."""


@dataclass(frozen=True, slots=True, eq=False)
class MovedTogether:
    """Landmarks of one sub-map that have one motion."""

    number: int
    map_id: str
    count: int
    displacement_global: Floats
    """(3,) of their middle"""
    distance: float
    """Length of it, global map units"""
    distance_std: float
    p_value: float
    turn_rad: float
    """0 where none can be told from the scatter of the landmarks"""


def moved_objects(changes: Sequence[Change]) -> tuple[MovedTogether, ...]:
    """Objects in the order of their numbers; single landmarks are in none."""
    by_number: dict[int, list[Change]] = {}
    for change in changes:
        by_number.setdefault(change.object_id, []).append(change)
    return tuple(
        _object(number, members) for number, members in sorted(by_number.items()) if number
    )


def _object(number: int, members: Sequence[Change]) -> MovedTogether:
    shifts = np.stack([change.displacement_global for change in members])
    after = np.stack([change.position_global for change in members])
    mean = shifts.mean(axis=0)
    distance = float(np.linalg.norm(mean))
    along = mean / distance if distance else mean
    first = members[0]
    return MovedTogether(
        number=number,
        map_id=first.map_id,
        count=len(members),
        displacement_global=mean,
        distance=distance,
        distance_std=float(np.sqrt(max(along @ first.covariance @ along, 0.0))),
        p_value=first.p_value,
        turn_rad=_turn(after - shifts, after),
    )


def _turn(before: Floats, after: Floats) -> float:
    """Angle of the rotation that the landmarks took, if their scatter does not explain it."""
    count = len(before)
    if count < MIN_TO_TURN:
        return 0.0
    try:
        motion = align(after, before, gauge=Gauge.RIGID).S_target_source
    except DegenerateGeometry:
        return 0.0
    residuals = motion.apply(before) - after
    freedom = 3 * count - 6
    arms = before - before.mean(axis=0)
    information = np.sum(arms**2) * np.eye(3) - arms.T @ arms
    vector = Rotation.from_matrix(motion.rotation).as_rotvec()
    variance = max(float(np.sum(residuals**2)) / freedom, np.finfo(float).tiny)
    statistic = float(vector @ information @ vector) / variance / 3.0
    is_turned = scipy.stats.f.sf(statistic, 3, freedom) < TURNED_LEVEL
    return float(np.linalg.norm(vector)) if is_turned else 0.0
