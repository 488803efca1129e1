# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A bundle as other programs deliver it, and what has to go before it can be linearised."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints, Mask
from mapmerge_ros.bundle import Bundle, FramePrior, linearise
from mapmerge_ros.bundle.elimination import is_determined, point_information
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.submap import Descriptors

MIN_VIEWS = 2
"""Key frames that determine a point."""
MIN_POINTS = 3
"""Points that determine a key frame: two equations each, six unknowns."""


@dataclass(frozen=True, slots=True, eq=False)
class Pruned:
    """What of a raw bundle can be used."""

    bundle: Bundle
    keyframe_rows: Ints
    """(m,) rows of its key frames in the raw one"""
    undetermined: int
    """Points that were left out because they have no parallax: nothing says how far they are"""


@dataclass(frozen=True, slots=True, eq=False)
class RawBundle:
    """The arrays of a `Bundle`, of the same shapes, of any quality; rows are in range."""

    intrinsics: Floats
    keyframe_ids: Ids
    keyframe_cameras: Ints
    rotations_camera_map: Floats
    translations_camera_map: Floats
    point_ids: Ids
    points: Floats
    observation_keyframes: Ints
    observation_points: Ints
    observations_px: Floats
    descriptors: Descriptors
    gauge: Gauge = Gauge.SIMILARITY
    prior: FramePrior = field(default_factory=FramePrior)
    sigma_px: float = 0.0

    def pruned(self) -> Pruned:
        """
        Bundle of what can be used.

        An observation goes if its point is behind the camera, if it is not finite or if it is
        the second of this point in this key frame; a point with fewer than two observations or
        without parallax goes, and a key frame with fewer than three, until nothing more has to.

        Raises
        ------
        InvalidValue
            Nothing is left, or an array breaks its contract.

        """
        kept, undetermined = self._usable(self._first_and_in_front()), 0
        while kept.any():
            bundle, frames, points = self._part(kept)
            loose = points[~is_determined(point_information(linearise(bundle)))]
            if not len(loose):
                return Pruned(bundle, frames, undetermined)
            undetermined += len(loose)
            kept = self._usable(kept & ~np.isin(self.observation_points, loose))
        if undetermined:
            raise InvalidValue(
                f'points: too few are left without {undetermined} that have no parallax'
            )
        raise InvalidValue('observations: no point is seen in front of two key frames')

    def _part(self, kept: Mask) -> tuple[Bundle, Ints, Ints]:
        """Bundle of some observations (o,), and the rows of its key frames and points."""
        frames = np.unique(self.observation_keyframes[kept])
        points = np.unique(self.observation_points[kept])
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        for name in ('ids', 'cameras'):
            values[f'keyframe_{name}'] = values[f'keyframe_{name}'][frames]
        for name in ('rotations_camera_map', 'translations_camera_map'):
            values[name] = values[name][frames]
        for name in ('point_ids', 'points', 'descriptors'):
            values[name] = values[name][points]
        values['observation_keyframes'] = np.searchsorted(frames, self.observation_keyframes[kept])
        values['observation_points'] = np.searchsorted(points, self.observation_points[kept])
        values['observations_px'] = self.observations_px[kept]
        return Bundle(**values), frames, points

    def _usable(self, kept: Mask) -> Mask:
        """What of some observations (o,) is left without lonely points and key frames."""
        frames, points = self.observation_keyframes, self.observation_points
        while True:
            views = np.bincount(points[kept], minlength=len(self.point_ids))
            seen = np.bincount(frames[kept], minlength=len(self.keyframe_ids))
            left = kept & (views[points] >= MIN_VIEWS) & (seen[frames] >= MIN_POINTS)
            if left.sum() == kept.sum():
                return left
            kept = left

    def _first_and_in_front(self) -> Mask:
        third_axes = self.rotations_camera_map[self.observation_keyframes, 2]
        depths = np.einsum('oi,oi->o', third_axes, self.points[self.observation_points])
        depths += self.translations_camera_map[self.observation_keyframes, 2]
        good = np.flatnonzero((depths > 0.0) & np.isfinite(self.observations_px).all(axis=1))
        pairs = self.observation_points * len(self.keyframe_ids) + self.observation_keyframes
        kept = np.zeros(len(pairs), bool)
        kept[good[np.unique(pairs[good], return_index=True)[1]]] = True
        return kept
