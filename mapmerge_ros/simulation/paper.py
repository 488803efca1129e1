# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The first experiment of the paper (5.A.1): one box of points, mapped several times."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.bundle import Bundle
from mapmerge_ros.simulation.adjust import MAX_ITERATIONS
from mapmerge_ros.simulation.scene import Scene, box_scene
from mapmerge_ros.simulation.session import measure
from mapmerge_ros.simulation.trajectory import Trajectory, all_around
from mapmerge_ros.submap import Descriptors

DISTANCE = (8.0, 10.0)
"""
Of the cameras from the centre of the box [m]; the paper does not say.

Its corners are at 5.9 m: nothing is ever behind a camera, nor close to one.
"""


def paper_box(
    rng: np.random.Generator,
    *,
    sigma: float = 0.05,
    maps: int = 3,
    points: int = 100,
    cameras: int = 10,
    seen_ratio: float = 1.0,
    max_iterations: int = MAX_ITERATIONS,
) -> tuple[Bundle, ...]:
    """
    Points in a box seen by new cameras for each map, each map adjusted by itself.

    The focal length is 1, so `sigma` and all 'pixels' are normalised image coordinates. Point
    ids are the same in all maps, frames and scales are not. With `seen_ratio` < 1 a camera
    misses some points (0.8 in 5.A.2).
    """
    return measured(box_truth(rng, maps, points, cameras, seen_ratio), rng, sigma, max_iterations)


def box_truth(
    rng: np.random.Generator,
    maps: int = 3,
    points: int = 100,
    cameras: int = 10,
    seen_ratio: float = 1.0,
) -> tuple[Bundle, ...]:
    """Return what is true in `paper_box`: for new noise in the same place, see `measured`."""
    scene = box_scene(rng, points)
    return tuple(
        _seen(rng, scene, all_around(rng, np.zeros(3), DISTANCE, cameras), seen_ratio)
        for _ in range(maps)
    )


def measured(
    truth: tuple[Bundle, ...],
    rng: np.random.Generator,
    sigma: float,
    max_iterations: int = MAX_ITERATIONS,
) -> tuple[Bundle, ...]:
    """Maps from noisy images of `box_truth`, each in a frame of its own."""
    return tuple(
        measure(each, rng, sigma_px=sigma, max_iterations=max_iterations).bundle for each in truth
    )


def _seen(
    rng: np.random.Generator, scene: Scene, trajectory: Trajectory, seen_ratio: float
) -> Bundle:
    visible = rng.random((len(trajectory.centres), len(scene))) < seen_ratio
    # A point that fewer than two would see is seen by all, as in the room.
    visible[:, visible.sum(axis=0) < 2] = True
    keyframes, points = np.nonzero(visible)
    rotations = trajectory.rotations_camera_world
    translations = trajectory.translations_camera_world
    points_camera = np.einsum('oij,oj->oi', rotations[keyframes], scene.points[points])
    points_camera += translations[keyframes]
    return Bundle(
        intrinsics=np.array([[1.0, 1.0, 0.0, 0.0]]),
        keyframe_ids=np.arange(len(rotations), dtype=np.uint64),
        keyframe_cameras=np.zeros(len(rotations), np.int64),
        rotations_camera_map=rotations,
        translations_camera_map=translations,
        point_ids=scene.ids,
        points=scene.points,
        observation_keyframes=keyframes,
        observation_points=points,
        observations_px=points_camera[:, :2] / points_camera[:, 2:],
        descriptors=Descriptors.none(len(scene)),
    )
