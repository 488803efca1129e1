# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The room of 5.A.3: four walls, each mapped by itself, that meet in a few corner landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Mask
from mapmerge_ros.bundle import Bundle
from mapmerge_ros.experiments.fleets import fleet_of
from mapmerge_ros.simulation import Fleet, Scene, Trajectory, look_at, measure, room_scene
from mapmerge_ros.submap import Descriptors, SubMap

SIZE = (5.0, 6.0, 2.0)
"""Of the room [m]"""

POINTS, CORNER, CAMERAS, SEEN_RATIO, SIGMA = 200, 5, 10, 0.77, 0.005
"""
Landmarks per map, shared with each neighbour (6 %), cameras, how many of them see a landmark.

What the table of the paper says: Jacobians of about 3000 x 660, 20 merged landmarks.
"""

WIDTHS = {'wide': 0.5, 'narrow': 0.1}
"""
How far the corner landmarks are spread [m].

Within 0.1 m they are nearly on a line, and the walls hinge about it.
"""

PRIVATE = np.uint64(1_000_000)
"""Offset to ids that are to match no other map's."""


def simulate_room(rng: np.random.Generator, corner_width: float) -> Fleet:
    """Four maps of a room whose corner landmarks are within `corner_width` [m] of the edge."""
    scene = room_scene(
        rng, POINTS - 2 * CORNER, SIZE, per_corner=CORNER, corner_width=corner_width
    )
    truth = [_wall_view(rng, scene, wall) for wall in range(4)]
    return fleet_of(scene, [measure(each, rng, sigma_px=SIGMA) for each in truth])


def without_last_match(scene: Scene, submaps: Sequence[SubMap]) -> tuple[SubMap, ...]:
    """Take the matches between the first and the last wall away: an open loop."""
    last = submaps[-1]
    closing = scene.ids[scene.surfaces == 7]
    own = np.where(
        np.isin(last.landmark_ids, closing), last.landmark_ids + PRIVATE, last.landmark_ids
    )
    return (*submaps[:-1], replace(last, landmark_ids=own))


def true_points(scene: Scene, ids: Ids) -> Floats:
    """Where landmarks (n,) are in truth, (n, 3) [m]; private ids are understood too."""
    points: Floats = scene.points[np.searchsorted(scene.ids, ids % PRIVATE)]
    return points


def _wall_view(rng: np.random.Generator, scene: Scene, wall: int) -> Bundle:
    """What is true about one wall and its two corners, seen by cameras in front of it."""
    corners = (4 + wall, 4 + (wall - 1) % 4)
    rows = np.flatnonzero(np.isin(scene.surfaces, (wall, *corners)))
    path = _path(rng, wall)
    keyframes, points = np.nonzero(_visible(rng, len(rows)))
    rotations, translations = path.rotations_camera_world, path.translations_camera_world
    in_camera = np.einsum('oij,oj->oi', rotations[keyframes], scene.points[rows[points]])
    in_camera += translations[keyframes]
    return Bundle(
        intrinsics=np.array([[1.0, 1.0, 0.0, 0.0]]),
        keyframe_ids=np.arange(CAMERAS, dtype=np.uint64),
        keyframe_cameras=np.zeros(CAMERAS, np.int64),
        rotations_camera_map=rotations,
        translations_camera_map=translations,
        point_ids=scene.ids[rows],
        points=scene.points[rows],
        observation_keyframes=keyframes,
        observation_points=points,
        observations_px=in_camera[:, :2] / in_camera[:, 2:],
        descriptors=Descriptors.none(len(rows)),
    )


def _path(rng: np.random.Generator, wall: int) -> Trajectory:
    """Cameras 2.5 to 4.5 m from the wall, looking at its middle part."""
    sign = 1.0 if wall < 2 else -1.0
    outward = sign * np.eye(3)[wall % 2]
    up = np.array([0.0, 0.0, 1.0])
    along, distance = np.cross(outward, up), SIZE[wall % 2] / 2.0

    def column(low: float, high: float) -> Floats:
        return rng.uniform(low, high, (CAMERAS, 1))

    centres = outward * (distance - column(2.5, 4.5)) + along * column(-1.5, 1.5)
    centres = centres + up * column(-0.6, 0.6)
    return look_at(centres, outward * distance + along * column(-1.0, 1.0), up)


def _visible(rng: np.random.Generator, count: int) -> Mask:
    """Which camera sees which landmark; one that fewer than two would see is seen by all."""
    visible: Mask = rng.random((CAMERAS, count)) < SEEN_RATIO
    visible[:, visible.sum(axis=0) < 2] = True
    return visible
