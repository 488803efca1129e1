# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot's own map before compression: cameras, key frames, points, observations."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from mapmerge_ros.arrays import Floats, Ids, Ints, frozen
from mapmerge_ros.bundle.lens import Lens
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.geometry import Gauge, Similarity
from mapmerge_ros.submap import Descriptors

if TYPE_CHECKING:
    from mapmerge_ros.bundle.compress import Update


@dataclass(frozen=True, slots=True)
class FramePrior:
    """
    How well the map frame is known from elsewhere (IMU, stereo, GNSS), as standard deviations.

    Only what the gauge claims to know is used: scale from gauge 6 down, gravity from 4 down,
    heading and position at 0.
    """

    scale_std_ratio: float = 0.01
    """Relative scale; 1 % is what visual-inertial odometry reaches."""
    gravity_std_rad: float = 0.005
    """Roll and pitch of the whole map."""
    heading_std_rad: float = 0.02
    position_std: float = 1.0
    """Offset of the whole map [map units]."""

    def __post_init__(self) -> None:
        for name in ('scale_std_ratio', 'gravity_std_rad', 'heading_std_rad', 'position_std'):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InvalidValue(f'{name}: {value} is not positive')


@dataclass(frozen=True, slots=True, eq=False)
class Bundle:
    """
    Pinhole cameras (after undistortion), poses, points, observations and descriptors.

    Every point is seen in at least two key frames, at most once in each.
    """

    intrinsics: Floats
    """(cameras, 4) fx fy cx cy [px]"""
    keyframe_ids: Ids
    """(m,)"""
    keyframe_cameras: Ints
    """(m,) row of `intrinsics`"""
    rotations_camera_map: Floats
    """(m, 3, 3), camera z forward"""
    translations_camera_map: Floats
    """(m, 3)"""
    point_ids: Ids
    """(n,)"""
    points: Floats
    """(n, 3) in the map frame"""
    observation_keyframes: Ints
    """(o,) row of the key frame arrays"""
    observation_points: Ints
    """(o,) row of the point arrays"""
    observations_px: Floats
    """(o, 2) undistorted u v"""
    descriptors: Descriptors
    """one row per point"""
    gauge: Gauge = Gauge.SIMILARITY
    prior: FramePrior = FramePrior()
    sigma_px: float = 0.0
    """Noise of one image coordinate; 0 = unknown"""
    prior_residuals_px: Floats = field(default_factory=lambda: np.zeros(0))
    """
    (7 - gauge,) how far the map has been moved away from what the prior says; empty = zeros.
    """
    lens: Lens = field(default_factory=Lens)
    """What is uncertain about the intrinsics, see `with_lens_prior`; by default nothing"""

    def __post_init__(self) -> None:
        m, n, o = len(self.keyframe_ids), len(self.point_ids), len(self.observation_points)
        for name, dtype, shape in (
            ('intrinsics', np.float64, (None, 4)),
            ('keyframe_ids', np.uint64, (m,)),
            ('keyframe_cameras', np.int64, (m,)),
            ('rotations_camera_map', np.float64, (m, 3, 3)),
            ('translations_camera_map', np.float64, (m, 3)),
            ('point_ids', np.uint64, (n,)),
            ('points', np.float64, (n, 3)),
            ('observation_keyframes', np.int64, (o,)),
            ('observation_points', np.int64, (o,)),
            ('observations_px', np.float64, (o, 2)),
        ):
            object.__setattr__(self, name, frozen(name, getattr(self, name), dtype, shape))
        known = 7 - int(self.gauge)
        moved = self.prior_residuals_px if len(self.prior_residuals_px) else np.zeros(known)
        moved = frozen('prior_residuals_px', moved, np.float64, (known,))
        object.__setattr__(self, 'prior_residuals_px', moved)
        self._check_rows()
        self._check_observations()

    def _check_rows(self) -> None:
        if not len(self.keyframe_ids):
            raise InvalidValue('keyframe_ids: a bundle without key frames')
        if not len(self.point_ids):
            raise InvalidValue('point_ids: a bundle without points')
        for name, bound in (
            ('keyframe_cameras', len(self.intrinsics)),
            ('observation_keyframes', len(self.keyframe_ids)),
            ('observation_points', len(self.point_ids)),
            ('lens.cameras', len(self.intrinsics)),
        ):
            rows = attrgetter(name)(self)
            if len(rows) and (rows.min() < 0 or rows.max() >= bound):
                raise InvalidValue(f'{name}: a row outside 0..{bound - 1}')
        for name in ('keyframe_ids', 'point_ids'):
            ids = getattr(self, name)
            if len(np.unique(ids)) != len(ids):
                raise InvalidValue(f'{name}: an id appears twice')
        if (self.intrinsics[:, :2] <= 0.0).any():
            raise InvalidValue('intrinsics: a focal length is not positive')
        if len(self.descriptors) != len(self.point_ids):
            raise InvalidValue(
                f'descriptors: {len(self.descriptors)} rows for {len(self.point_ids)} points'
            )
        if not (np.isfinite(self.sigma_px) and self.sigma_px >= 0.0):
            raise InvalidValue(f'sigma_px: {self.sigma_px} is not a finite, non-negative number')

    def _check_observations(self) -> None:
        views = np.bincount(self.observation_points, minlength=len(self.point_ids))
        if (views < 2).any():
            bad = self.point_ids[int(np.argmin(views))]
            raise InvalidValue(f'observations_px: point {bad} has fewer than two key frames')
        pairs = self.observation_points * len(self.keyframe_ids) + self.observation_keyframes
        if len(np.unique(pairs)) != len(pairs):
            raise InvalidValue('observations_px: a point is observed twice in one key frame')
        depths = self.points_camera()[:, 2]
        if (depths <= 0.0).any():
            bad = self.point_ids[self.observation_points[int(np.argmin(depths))]]
            raise InvalidValue(f'points: point {bad} is behind a camera that observes it')

    @property
    def residual_count(self) -> int:
        """η: image coordinates, frame directions known from elsewhere, uncertain lenses."""
        return self.observations_px.size + 7 - int(self.gauge) + self.lens.size

    @property
    def dof(self) -> int:
        """d: parameters that the residuals determine."""
        poses, points = 6 * len(self.keyframe_ids), 3 * len(self.point_ids)
        return poses + points - int(self.gauge) + self.lens.size

    def points_camera(self) -> Floats:
        """Observed points (o, 3) in the frame of the observing camera."""
        rotations = self.rotations_camera_map[self.observation_keyframes]
        turned: Floats = np.einsum('oij,oj->oi', rotations, self.points[self.observation_points])
        return turned + self.translations_camera_map[self.observation_keyframes]

    def centres_map(self) -> Floats:
        """Camera centres (m, 3) in the map frame."""
        offsets: Floats = np.einsum(
            'mji,mj->mi', self.rotations_camera_map, self.translations_camera_map
        )
        return -offsets

    def moved(
        self,
        pose_steps: Floats,
        point_steps: Floats,
        prior_steps: Floats | float = 0.0,
        lens_steps: Floats | float = 0.0,
    ) -> Bundle:
        """
        Apply local steps: poses (m, 6) rotation vector [rad] and translation, points (n, 3).

        `prior_steps` (7 - gauge,) [px] is what that does to the residuals of the frame prior,
        `lens_steps` (l, 7) [px] is by how much the lenses move.
        """
        turns = Rotation.from_rotvec(pose_steps[:, :3]).as_matrix()
        return replace(
            self,
            rotations_camera_map=turns @ self.rotations_camera_map,
            translations_camera_map=self.translations_camera_map + pose_steps[:, 3:],
            points=self.points + point_steps,
            prior_residuals_px=self.prior_residuals_px + prior_steps,
            lens=replace(self.lens, moved_px=self.lens.moved_px + lens_steps),
        )

    def transformed(self, S_new_old: Similarity) -> Bundle:
        """Return the same bundle in another frame and scale; no residual changes."""
        rotations = self.rotations_camera_map @ S_new_old.rotation.T
        shift = np.einsum('mij,j->mi', rotations, S_new_old.translation)
        return replace(
            self,
            rotations_camera_map=rotations,
            translations_camera_map=S_new_old.scale * self.translations_camera_map - shift,
            points=S_new_old.apply(self.points),
        )

    def update(self, landmark_ids: Ids, points_global: Floats) -> Update:
        """Cameras and points that follow from merged landmarks: see `compress.update`."""
        from mapmerge_ros.bundle.compress import update  # that module is about this value

        return update(self, landmark_ids, points_global)

    def rows_of(self, point_ids: Ids) -> Ints:
        """
        Rows of the given point ids.

        Raises
        ------
        InvalidValue
            An id that this bundle does not have.

        """
        order = np.argsort(self.point_ids)
        slots = np.searchsorted(self.point_ids, point_ids, sorter=order)
        rows = order[np.minimum(slots, len(order) - 1)]
        missing = self.point_ids[rows] != np.asarray(point_ids, np.uint64)
        if missing.any():
            raise InvalidValue(
                f'landmark_ids: point {np.asarray(point_ids)[missing][0]} is not in this bundle'
            )
        return rows
