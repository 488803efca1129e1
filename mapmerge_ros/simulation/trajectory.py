# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the cameras are: paths of drones over a scene, in the world frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, frozen


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of key frames; camera z forward, x right, y down."""

    rotations_camera_world: Floats
    """(m, 3, 3)"""
    centres: Floats
    """(m, 3) in the world frame [m]"""

    def __post_init__(self) -> None:
        m = len(self.centres)
        rotations = frozen('rotations_camera_world', self.rotations_camera_world, float, (m, 3, 3))
        object.__setattr__(self, 'rotations_camera_world', rotations)
        object.__setattr__(self, 'centres', frozen('centres', self.centres, float, (m, 3)))

    @property
    def translations_camera_world(self) -> Floats:
        """Translations (m, 3)."""
        turned: Floats = np.einsum('mij,mj->mi', self.rotations_camera_world, self.centres)
        return -turned


def look_at(centres: Floats, targets: Floats, upwards: Floats) -> Trajectory:
    """Cameras at `centres` (m, 3) facing `targets`, image top towards `upwards` (..., 3)."""
    forward = _unit(targets - centres)
    right = _unit(np.cross(forward, upwards))
    rotations = np.stack([right, np.cross(forward, right), forward], axis=1)
    return Trajectory(rotations, centres)


def lawn_mower(
    rng: np.random.Generator,
    centre: Floats,
    extent: tuple[float, float],
    keyframes: int,
    *,
    lanes: int = 2,
    tilt_rad: float = 0.35,
    jitter: float = 0.5,
) -> Trajectory:
    """
    Strips along x over `extent` (length, width) [m] about `centre` (3,), looking down.

    The camera looks `tilt_rad` ahead of the vertical, so that façades are seen; `jitter` [m] is
    the wind. Every other lane is flown the other way round.
    """
    along = np.array_split(np.arange(keyframes), lanes)
    across = np.linspace(-0.5, 0.5, lanes) if lanes > 1 else np.zeros(1)
    places, heading = np.zeros((keyframes, 3)), np.zeros((keyframes, 3))
    for lane, rows in enumerate(along):
        direction = 1.0 if lane % 2 == 0 else -1.0
        places[rows, 0] = direction * np.linspace(-0.5, 0.5, len(rows)) * extent[0]
        places[rows, 1] = across[lane] * extent[1]
        heading[rows, 0] = direction
    centres = centre + places + jitter * rng.normal(size=(keyframes, 3))
    heading[:, 1:] += 0.05 * rng.normal(size=(keyframes, 2))
    view = np.sin(tilt_rad) * heading - np.cos(tilt_rad) * np.array([0.0, 0.0, 1.0])
    return look_at(centres, centres + view, heading)


def arc(
    target: Floats, radius: float, height: float, keyframes: int, span_rad: tuple[float, float]
) -> Trajectory:
    """Part of a circle around `target` (3,), `height` above it, looking at it [m, rad]."""
    angle = np.linspace(*span_rad, keyframes)
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    centres = target + np.column_stack([ring, np.full(keyframes, height)])
    return look_at(centres, np.broadcast_to(target, centres.shape), np.array([0.0, 0.0, 1.0]))


def all_around(
    rng: np.random.Generator, target: Floats, distance: tuple[float, float], keyframes: int
) -> Trajectory:
    """Cameras in random directions and distances [m] from `target` (3,), looking at it."""
    directions = _unit(rng.normal(size=(keyframes, 3)))
    centres = target + directions * rng.uniform(*distance, (keyframes, 1))
    upwards = rng.normal(size=(keyframes, 3))
    return look_at(centres, np.broadcast_to(target, centres.shape), upwards)


def _unit(vectors: Floats) -> Floats:
    lengths: Floats = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / lengths
