# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a drone sees of a scene on its way, and the map that it makes of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.bundle import Bundle, FramePrior
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.simulation.adjust import MAX_ITERATIONS
from mapmerge_ros.simulation.scene import Scene
from mapmerge_ros.simulation.session import (
    Session,
    SimulationError,
    measure,
    with_descriptors,
    with_private_ids,
)
from mapmerge_ros.simulation.trajectory import Trajectory
from mapmerge_ros.submap import Descriptors


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera; by default that of the EuRoC drones."""

    focal_px: float = 500.0
    width_px: int = 752
    height_px: int = 480

    @property
    def intrinsics(self) -> Floats:
        """Focal lengths and principal point (4,): fx fy cx cy [px]."""
        return np.array([self.focal_px, self.focal_px, self.width_px / 2.0, self.height_px / 2.0])


@dataclass(frozen=True, slots=True)
class Sensing:
    """What a drone can see and how well."""

    camera: Camera = field(default_factory=Camera)
    sigma_px: float = 0.5
    """Noise of one image coordinate."""
    range_m: tuple[float, float] = (0.5, 40.0)
    """Nearest and farthest point that is tracked."""
    max_incidence_rad: float = 1.2
    """Off the surface normal; features are not recognised at a more grazing view."""
    detection_ratio: float = 0.9
    """Visible points that a detector really finds in an image."""
    min_views: int = 3
    """Two views alone leave errors that lie along the ray, and mismatches, undetected."""
    min_parallax_rad: float = 0.02
    """Off the mean ray; below it the depth is too uncertain to linearise."""
    flip_ratio: float = 0.03
    """Bits of a descriptor that differ from the landmark's; ORB matches differ by 5 to 20 %."""
    gauge: Gauge = Gauge.SIMILARITY
    prior: FramePrior = field(default_factory=FramePrior)


def fly(
    rng: np.random.Generator,
    scene: Scene,
    trajectory: Trajectory,
    sensing: Sensing | None = None,
    *,
    descriptors: bool = True,
    private_ids: bool = False,
    max_iterations: int = MAX_ITERATIONS,
) -> Session:
    """
    Session of a drone that flies `trajectory` over `scene`.

    Raises
    ------
    SimulationError
        It sees too little to make a map.
    AdjustmentError
        See `adjust`.

    """
    sensing = sensing or Sensing()
    # One stream for each cause: noise stays the same when a landmark more is seen.
    streams = rng.spawn(4)
    session = measure(
        observe(streams[0], scene, trajectory, sensing),
        streams[1],
        sigma_px=sensing.sigma_px,
        gauge=sensing.gauge,
        prior=sensing.prior,
        max_iterations=max_iterations,
    )
    if descriptors:
        rows = np.searchsorted(scene.ids, session.landmark_ids)
        looks = scene.descriptors[rows]
        session = with_descriptors(session, streams[2], looks, sensing.flip_ratio)
    return with_private_ids(session, streams[3]) if private_ids else session


def observe(
    rng: np.random.Generator, scene: Scene, trajectory: Trajectory, sensing: Sensing
) -> Bundle:
    """
    True poses, points and image points of what is seen, in the world frame.

    Raises
    ------
    SimulationError
        A key frame without points, or none seen often enough.

    """
    rows = _within_reach(scene, trajectory, sensing.range_m[1])
    pixels, visible = _project(scene, rows, trajectory, sensing)
    visible &= rng.random(visible.shape) < sensing.detection_ratio
    kept = _trackable(scene.points[rows], trajectory, visible, sensing)
    visible, pixels, rows = visible[:, kept], pixels[:, kept], rows[kept]
    views = visible.sum(axis=1)
    if len(rows) < 10 or views.min() < 4:
        raise SimulationError(
            f'a drone sees {len(rows)} landmarks, {views.min()} in its poorest key frame: '
            'add landmarks or move the trajectory'
        )
    keyframes, points = np.nonzero(visible)
    m = len(trajectory.centres)
    return Bundle(
        intrinsics=sensing.camera.intrinsics[None],
        keyframe_ids=np.arange(m, dtype=np.uint64),
        keyframe_cameras=np.zeros(m, np.int64),
        rotations_camera_map=trajectory.rotations_camera_world,
        translations_camera_map=trajectory.translations_camera_world,
        point_ids=scene.ids[rows],
        points=scene.points[rows],
        observation_keyframes=keyframes,
        observation_points=points,
        observations_px=pixels[visible],
        descriptors=Descriptors.none(len(rows)),
    )


def _within_reach(scene: Scene, trajectory: Trajectory, max_range: float) -> Ints:
    """Rows of the landmarks that may be visible at all: keeps large scenes cheap."""
    low = trajectory.centres.min(axis=0) - max_range
    high = trajectory.centres.max(axis=0) + max_range
    return np.flatnonzero(((scene.points > low) & (scene.points < high)).all(axis=1))


def _project(
    scene: Scene, rows: Ints, trajectory: Trajectory, sensing: Sensing
) -> tuple[Floats, Mask]:
    """Image points (m, n, 2) [px] and which of them are visible (m, n)."""
    camera, normals = sensing.camera, scene.normals[rows]
    offsets = scene.points[rows] - trajectory.centres[:, None]
    distances = np.linalg.norm(offsets, axis=2)
    points_camera = offsets @ trajectory.rotations_camera_world.transpose(0, 2, 1)
    depths = points_camera[:, :, 2]
    in_front = depths > 1e-3 * distances
    bearings = points_camera[:, :, :2] / np.where(in_front, depths, 1.0)[:, :, None]
    pixels = camera.focal_px * bearings + camera.intrinsics[2:]
    inside = ((pixels >= 0.0) & (pixels < [camera.width_px, camera.height_px])).all(axis=2)
    near, far = sensing.range_m
    facing = (
        -np.einsum('mnj,nj->mn', offsets, normals) > np.cos(sensing.max_incidence_rad) * distances
    )
    facing |= ~normals.any(axis=1)
    return pixels, in_front & inside & facing & (distances > near) & (distances < far)


def _trackable(points: Floats, trajectory: Trajectory, visible: Mask, sensing: Sensing) -> Ints:
    """Rows of the points (n, 3) seen from enough places that are far enough apart."""
    rays = points - trajectory.centres[:, None]
    rays = np.where(visible[:, :, None], rays / np.linalg.norm(rays, axis=2)[:, :, None], 0.0)
    mean = rays.sum(axis=0)
    mean /= np.maximum(np.linalg.norm(mean, axis=1), 1e-12)[:, None]
    offset = np.linalg.norm(np.cross(rays, mean), axis=2).max(axis=0, initial=0.0)
    enough = visible.sum(axis=0) >= sensing.min_views
    return np.flatnonzero(enough & (offset > np.sin(sensing.min_parallax_rad)))
