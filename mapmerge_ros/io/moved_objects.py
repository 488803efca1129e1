# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks that moved together, as one object with one motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.distributions import chi2_tail
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion import Change
from mapmerge_ros.geometry import Gauge, align, skew
from mapmerge_ros.geometry.rotations import as_rotation

TURNED_LEVEL = 1e-3
"""p-value below which a turn is told: it is one of many that are looked at."""

MIN_TO_TURN = 5
"""Landmarks: those of four do not determine the covariance of their motion."""

STILL_RAD = 1e-9
"""Standard deviation of a turn below which none was estimated."""


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
    """0 where it is not certain that there is one"""


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
    covariances = np.stack([change.covariance for change in members])
    mean = shifts.mean(axis=0)
    distance = float(np.linalg.norm(mean))
    along = mean / distance if distance else mean
    # The members have one motion: the mean of their displacements is no surer than each.
    own = covariances.mean(axis=0)
    turn_rad = 0.0
    if len(members) >= MIN_TO_TURN:
        together = _motion_covariance(after, covariances)
        own, turn_rad = together[3:, 3:], _turn(after - shifts, after, together[:3, :3])
    return MovedTogether(
        number=number,
        map_id=members[0].map_id,
        count=len(members),
        displacement_global=mean,
        distance=distance,
        distance_std=float(np.sqrt(max(along @ own @ along, 0.0))),
        p_value=members[0].p_value,
        turn_rad=turn_rad,
    )


def _motion_covariance(after: Floats, covariances: Floats) -> Floats:
    """
    Covariance (6, 6) of turn and translation, as those (n, 3, 3) of the displacements show it.

    A displacement is B m with m the motion and B = [-[arm]x I]: its covariance is B Σ Bᵀ, linear
    in Σ.
    """
    arms = after - after.mean(axis=0)
    size = float(np.sqrt(np.mean(arms**2))) or 1.0
    basis = np.concatenate(
        [-skew(arms / size), np.broadcast_to(np.eye(3), (len(arms), 3, 3))], axis=2
    )
    equations = np.einsum('nia,njb->nijab', basis, basis).reshape(-1, 36)
    found = np.linalg.lstsq(equations, covariances.ravel(), rcond=1e-9)[0].reshape(6, 6)
    units = np.repeat([1.0 / size, 1.0], 3)
    covariance: Floats = (found + found.T) / 2.0 * np.outer(units, units)
    return covariance


def _turn(before: Floats, after: Floats, covariance: Floats) -> float:
    """Angle of the rotation that they took, unless its covariance (3, 3) explains it."""
    try:
        motion = align(after, before, gauge=Gauge.RIGID).S_target_source
    except DegenerateGeometry:
        return 0.0
    vector = as_rotation(motion.rotation).as_rotvec()
    variances, axes = np.linalg.eigh(covariance)
    if variances.max() < STILL_RAD**2:
        return 0.0
    # An axis whose variance cannot be read is taken to be as uncertain as the worst.
    known = np.where(variances > 1e-6 * variances.max(), variances, variances.max())
    statistic = float(np.sum((axes.T @ vector) ** 2 / known))
    is_turned = chi2_tail(statistic, 3) < TURNED_LEVEL
    return float(np.linalg.norm(vector)) if is_turned else 0.0
