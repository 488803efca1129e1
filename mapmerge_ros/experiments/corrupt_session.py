# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A drone circles over a yard; for a stretch of its way, some landmarks are not where they are."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.bundle import Bundle, linearise
from mapmerge_ros.simulation import Sensing, arc, measure, observe, yard_scene

KEYFRAMES = 96
LANDMARKS, YARD = 100, (22.0, 22.0)
ORBIT_RADIUS, ORBIT_HEIGHT, ROUNDS = 22.0, 16.0, 2
"""[m]"""
CORRUPT_KEYFRAMES, CORRUPT_LANDMARKS = (6, 16), 10
"""Shortest and longest corrupt stretch, up to a sixth of the session."""

SHIFT = 0.5
"""
In the corrupt stretch, neighbouring landmarks are seen this far from where they are [m].

As of a parked car that was away for a while, or of a structure taken for its neighbour.
"""

MIN_SEEN_RATIO = 0.7
"""Of the stretch, in which each of those landmarks is seen."""

SENSING = Sensing(detection_ratio=0.9, min_views=12, min_parallax_rad=0.2)


@dataclass(frozen=True, slots=True, eq=False)
class Damage:
    """What is wrong with a session: rows of its bundle."""

    keyframe_rows: Ints
    """That have a wrong image point"""
    landmark_rows: Ints


@dataclass(frozen=True, slots=True, eq=False)
class DamagedSession:
    """A session as the robot bundled it, and what it does not know."""

    bundle: Bundle
    truth: Bundle
    """Right image points, world frame [m]"""
    damage: Damage


def damaged_session(rng: np.random.Generator) -> DamagedSession:
    """Fly, damage, and bundle all of it: the map that one begins to doubt."""
    site, flight, noise = rng.spawn(3)
    scene = yard_scene(site, LANDMARKS, YARD, houses=2)
    orbit = arc(np.zeros(3), ORBIT_RADIUS, ORBIT_HEIGHT, KEYFRAMES, (0.0, ROUNDS * 2.0 * np.pi))
    truth = observe(flight, scene, orbit, SENSING)
    damage = _choose(site, truth)
    session = measure(_damaged(truth, damage, site), noise, sigma_px=SENSING.sigma_px)
    return DamagedSession(session.bundle, truth, damage)


def _choose(rng: np.random.Generator, truth: Bundle) -> Damage:
    """A stretch anywhere, and neighbouring landmarks that it sees."""
    length = int(rng.integers(CORRUPT_KEYFRAMES[0], CORRUPT_KEYFRAMES[1] + 1))
    rows = int(rng.integers(0, KEYFRAMES - length + 1)) + np.arange(length)
    in_stretch = np.isin(truth.observation_keyframes, rows)
    seen, views = np.unique(truth.observation_points[in_stretch], return_counts=True)
    seen = seen[views >= MIN_SEEN_RATIO * length]
    centre = truth.points[rng.choice(seen)]
    near = np.argsort(np.linalg.norm(truth.points[seen] - centre, axis=1))
    landmarks = seen[near[:CORRUPT_LANDMARKS]]
    wrong = in_stretch & np.isin(truth.observation_points, landmarks)
    return Damage(np.unique(truth.observation_keyframes[wrong]), landmarks)


def _damaged(truth: Bundle, damage: Damage, rng: np.random.Generator) -> Bundle:
    """Return the true session with wrong image points of some landmarks in some key frames."""
    angle = rng.uniform(-np.pi, np.pi)
    points = truth.points.copy()
    points[damage.landmark_rows] += SHIFT * np.array([np.cos(angle), np.sin(angle), 0.0])
    seen = linearise(replace(truth, points=points))
    wrong = np.isin(truth.observation_keyframes, damage.keyframe_rows)
    wrong &= np.isin(truth.observation_points, damage.landmark_rows)
    shift_px = seen.residuals_px * wrong[:, None]
    return replace(truth, observations_px=truth.observations_px + shift_px)
