# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Small random bundles with truth, made without a solver: what compression tests need."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mapmerge_ros.bundle import Bundle, FramePrior
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.submap import Descriptors


def looking_at(centres, target):
    """Rotations camera_from_map of cameras at `centres` (m, 3) that look at one point."""
    forward = target - centres
    forward /= np.linalg.norm(forward, axis=1)[:, None]
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1)[:, None]
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def random_bundle(
    seed=0, *, keyframes=6, points=30, gauge=Gauge.SIMILARITY, noise_px=0.5, off=0.0, spread=1.0
):
    """
    Key frames on an arc around a cloud of points, every point seen by most of them.

    `off` moves poses and points away from where the observations come from, so that the bundle
    is not at its optimum; `spread` shrinks the baseline, which spoils the conditioning.
    """
    rng = np.random.default_rng(seed)
    cloud = rng.uniform([-3.0, -2.0, -1.0], [3.0, 2.0, 1.0], size=(points, 3))
    angles = spread * np.linspace(-1.0, 1.0, keyframes)
    centres = np.column_stack(
        [9 * np.sin(angles), -9 * np.cos(angles), rng.uniform(0, 2, keyframes)]
    )
    rotations = looking_at(centres, np.zeros(3))
    translations = -np.einsum('mij,mj->mi', rotations, centres)
    seen = rng.random((points, keyframes)) < 0.8
    seen[:, :2] = True
    rows, frames = np.nonzero(seen)
    intrinsics = np.array([[500.0, 510.0, 376.0, 240.0], [450.0, 450.0, 320.0, 240.0]])
    cameras = np.arange(keyframes) % 2
    camera_points = np.einsum('oij,oj->oi', rotations[frames], cloud[rows]) + translations[frames]
    k = intrinsics[cameras[frames]]
    pixels = k[:, :2] * camera_points[:, :2] / camera_points[:, 2:] + k[:, 2:]
    bundle = Bundle(
        intrinsics=intrinsics,
        keyframe_ids=np.arange(keyframes) + 10,
        keyframe_cameras=cameras,
        rotations_camera_map=rotations,
        translations_camera_map=translations,
        point_ids=rng.permutation(points) + 100,
        points=cloud,
        observation_keyframes=frames,
        observation_points=rows,
        observations_px=pixels + noise_px * rng.normal(size=pixels.shape),
        descriptors=Descriptors.none(points),
        gauge=gauge,
        prior=FramePrior(),
    )
    return bundle.moved(
        off * 0.1 * rng.normal(size=(keyframes, 6)), off * rng.normal(size=(points, 3))
    )


def with_a_turn_on_the_spot(bundle, turn_rad=0.1):
    """
    Add key frame 999 at the very place of the first, and point 999 that only these two see.

    The other points of the first key frame are seen in the new one too, without noise.
    """
    R, t = bundle.rotations_camera_map[0], bundle.translations_camera_map[0]
    turned = Rotation.from_rotvec([0.0, turn_rad, 0.0]).as_matrix()
    new_point = R.T @ (np.array([0.3, 0.2, 9.0]) - t)
    points = np.vstack([bundle.points, new_point])
    old = bundle.observation_points[bundle.observation_keyframes == 0]
    added, frame = len(bundle.points), len(bundle.keyframe_ids)
    rows = np.r_[added, old, added]
    frames = np.r_[0, np.full(len(old) + 1, frame)]
    in_first = points[rows] @ R.T + t
    in_camera = np.vstack([in_first[:1], in_first[1:] @ turned.T])
    k = bundle.intrinsics[bundle.keyframe_cameras[0]]
    pixels = k[:2] * in_camera[:, :2] / in_camera[:, 2:] + k[2:]
    return replace(
        bundle,
        keyframe_ids=np.append(bundle.keyframe_ids, np.uint64(999)),
        keyframe_cameras=np.append(bundle.keyframe_cameras, bundle.keyframe_cameras[0]),
        rotations_camera_map=np.concatenate([bundle.rotations_camera_map, [turned @ R]]),
        translations_camera_map=np.vstack([bundle.translations_camera_map, turned @ t]),
        point_ids=np.append(bundle.point_ids, np.uint64(999)),
        points=points,
        observation_keyframes=np.append(bundle.observation_keyframes, frames),
        observation_points=np.append(bundle.observation_points, rows),
        observations_px=np.vstack([bundle.observations_px, pixels]),
        descriptors=Descriptors.none(added + 1),
    )


def seen_only(bundle, kept):
    """Return the bundle of some observations (o,), with the points that two of them see."""
    views = np.bincount(bundle.observation_points[kept], minlength=len(bundle.points))
    points = np.flatnonzero(views >= 2)
    kept = kept & np.isin(bundle.observation_points, points)
    return replace(
        bundle,
        point_ids=bundle.point_ids[points],
        points=bundle.points[points],
        descriptors=bundle.descriptors[points],
        observation_keyframes=bundle.observation_keyframes[kept],
        observation_points=np.searchsorted(points, bundle.observation_points[kept]),
        observations_px=bundle.observations_px[kept],
    )


def without_points(bundle, ids):
    """Return the bundle without some of its points."""
    return seen_only(bundle, ~np.isin(bundle.point_ids[bundle.observation_points], ids))


def assert_same_elimination(fast, dense):
    """The same cost, and the same way back to what was eliminated, to 1e-8."""
    size = np.abs(dense.r.T @ dense.r).max()
    np.testing.assert_allclose(fast.r.T @ fast.r / size, dense.r.T @ dense.r / size, atol=1e-8)
    np.testing.assert_allclose(fast.a, dense.a, rtol=1e-8)
    gradient = dense.r.T @ dense.c
    np.testing.assert_allclose(
        fast.r.T @ fast.c, gradient, atol=1e-8 * max(np.abs(gradient).max(), 1)
    )
    size = np.abs(dense.session_by_shared).max()
    np.testing.assert_allclose(
        fast.session_by_shared / size, dense.session_by_shared / size, atol=1e-8
    )
    np.testing.assert_allclose(fast.session_offset, dense.session_offset, atol=1e-8)
