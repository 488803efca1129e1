# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Residuals of a bundle and their analytic Jacobian (eq. 1 of the paper, in pixels)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from mapmerge_ros.arrays import Floats
from mapmerge_ros.bundle.bundle import Bundle
from mapmerge_ros.geometry import skew


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """r + J δ at the current point of a bundle, one block per observation."""

    bundle: Bundle
    residuals_px: Floats
    """(o, 2) projection minus observation"""
    by_pose: Floats
    """(o, 2, 6) rotation vector [px/rad] and translation [px/map unit] of the key frame"""
    by_point: Floats
    """(o, 2, 3) [px/map unit]"""
    by_lens: Floats
    """(o, 2, 7 l) [px/px] parameters of the uncertain lenses"""
    prior_rows: Floats
    """(7 - gauge, 6m) rows of the frame prior on all poses; its residual is the bundle's"""

    @property
    def cost_px2(self) -> float:
        """Sum of all squared residuals, priors included."""
        known = self.known_residuals_px
        return float(np.sum(self.residuals_px**2) + known @ known)

    @property
    def session_size(self) -> int:
        """Columns of what belongs to no single point: 6 of each pose, then 7 of each lens."""
        return 6 * len(self.bundle.keyframe_ids) + self.bundle.lens.size

    @property
    def known_rows(self) -> Floats:
        """Rows (7 - gauge + 7 l, 6m + 7 l) of both priors, on poses and lenses."""
        lenses = self.bundle.lens.weight * np.eye(self.bundle.lens.size)
        rows: Floats = scipy.linalg.block_diag(self.prior_rows, lenses)
        return rows

    @property
    def known_residuals_px(self) -> Floats:
        """Residuals (7 - gauge + 7 l,) of both priors."""
        return np.concatenate([self.bundle.prior_residuals_px, self.bundle.lens.residuals_px])

    def moved(self, pose_steps: Floats, point_steps: Floats, lens_steps: Floats) -> Bundle:
        """
        Bundle after local steps (m, 6), (n, 3), (l, 7), with what they do to the priors.

        Raises
        ------
        InvalidValue
            A point steps behind a camera that observes it.

        """
        prior_steps = self.prior_rows @ pose_steps.ravel()
        return self.bundle.moved(pose_steps, point_steps, prior_steps, lens_steps)


def linearise(bundle: Bundle) -> Linearisation:
    """Residuals and Jacobian of all observations, and the rows of the frame prior."""
    keyframes, lens = bundle.observation_keyframes, bundle.lens
    cameras = bundle.keyframe_cameras[keyframes]
    camera = bundle.intrinsics[cameras]
    focal_px, centre_px = camera[:, :2], camera[:, 2:]
    points_camera = bundle.points_camera()
    inverse_depth = 1.0 / points_camera[:, 2]
    bearing = points_camera[:, :2] * inverse_depth[:, None]
    by_camera_point = np.zeros((len(keyframes), 2, 3))
    by_camera_point[:, 0, 0] = by_camera_point[:, 1, 1] = inverse_depth
    by_camera_point[:, :, 2] = -bearing * inverse_depth[:, None]
    by_bearing = by_camera_point
    by_camera_point = by_bearing * focal_px[:, :, None]
    by_lens = lens.derivative(cameras, bearing, focal_px)
    residuals_px = focal_px * bearing + centre_px - bundle.observations_px
    if lens.moved_px.any():
        residuals_px += by_lens @ lens.moved_px.ravel()
        by_camera_point += lens.slopes(cameras, bearing, focal_px) @ by_bearing
    turned = points_camera - bundle.translations_camera_map[keyframes]
    by_pose = np.empty((len(keyframes), 2, 6))
    by_pose[:, :, :3] = -by_camera_point @ skew(turned)
    by_pose[:, :, 3:] = by_camera_point
    return Linearisation(
        bundle=bundle,
        residuals_px=residuals_px,
        by_pose=by_pose,
        by_point=by_camera_point @ bundle.rotations_camera_map[keyframes],
        by_lens=by_lens,
        prior_rows=_prior_rows(bundle),
    )


def _prior_rows(bundle: Bundle) -> Floats:
    """
    Rows that hold the frame where the gauge says that it is known, (7 - gauge, 6m).

    Scale is that of the camera centres about their mean, rotation and position the mean over
    the key frames; each row is (sigma / standard deviation) times that quantity.
    """
    m = len(bundle.keyframe_ids)
    centres = bundle.centres_map()
    centred = centres - centres.mean(axis=0)
    to_map = bundle.rotations_camera_map.transpose(0, 2, 1)
    centre_by_pose = -np.concatenate(
        [to_map @ skew(bundle.translations_camera_map), to_map], axis=2
    )
    turn_by_pose = np.concatenate([-to_map, np.zeros((m, 3, 3))], axis=2)
    extent = float(np.sum(centred**2)) or 1.0
    scale = np.einsum('mi,mij->mj', centred / extent, centre_by_pose)
    prior, sigma_px = bundle.prior, bundle.sigma_px or 1.0
    # Ordered as the gauges are nested: 6 knows the first row, 4 the first three, 0 all.
    rows = [
        scale.ravel() / prior.scale_std_ratio,
        turn_by_pose[:, 0].ravel() / (m * prior.gravity_std_rad),
        turn_by_pose[:, 1].ravel() / (m * prior.gravity_std_rad),
        turn_by_pose[:, 2].ravel() / (m * prior.heading_std_rad),
        *(centre_by_pose[:, axis].ravel() / (m * prior.position_std) for axis in range(3)),
    ]
    return sigma_px * np.array(rows[: 7 - int(bundle.gauge)]).reshape(-1, 6 * m)
