# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A session divided along its trajectory: parts share landmarks, never an image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapmerge_ros.arrays import Ids, Ints
from mapmerge_ros.bundle import Bundle
from mapmerge_ros.errors import InvalidValue

MIN_VIEWS = 2
"""Of a point that a part keeps: from two views, a wrong match along the ray goes unseen."""


def stretches(keyframe_rows: Ints, count: int) -> list[Ints]:
    """Divide key frames, in the order of the trajectory, into runs of almost equal length."""
    return np.array_split(keyframe_rows, count)


def part_of(bundle: Bundle, keyframe_rows: Ints, *, min_views: int = MIN_VIEWS) -> Bundle:
    """
    Some key frames of a monocular bundle with the points that `min_views` of them see.

    Not adjusted; poses and points start from the whole bundle. An image belongs to one part:
    in two, it would count twice. (A frame prior would do so too, hence monocular.)

    Raises
    ------
    InvalidValue
        No point is seen often enough.

    """
    used = np.isin(bundle.observation_keyframes, keyframe_rows)
    n = len(bundle.point_ids)
    views = np.bincount(bundle.observation_points[used], minlength=n)
    points = np.flatnonzero(views >= min_views)
    used &= np.isin(bundle.observation_points, points)
    return replace(
        bundle,
        keyframe_ids=bundle.keyframe_ids[keyframe_rows],
        keyframe_cameras=bundle.keyframe_cameras[keyframe_rows],
        rotations_camera_map=bundle.rotations_camera_map[keyframe_rows],
        translations_camera_map=bundle.translations_camera_map[keyframe_rows],
        point_ids=bundle.point_ids[points],
        points=bundle.points[points],
        observation_keyframes=_renumbered(
            keyframe_rows, bundle.observation_keyframes[used], len(bundle.keyframe_ids)
        ),
        observation_points=_renumbered(points, bundle.observation_points[used], n),
        observations_px=bundle.observations_px[used],
        descriptors=bundle.descriptors[points],
    )


def shared_ids(parts: list[Bundle]) -> Ids:
    """Landmarks that two or more of the bundles have."""
    if not parts:
        raise InvalidValue('parts: none')
    ids, counts = np.unique(np.concatenate([p.point_ids for p in parts]), return_counts=True)
    return np.asarray(ids[counts >= 2])


def _renumbered(kept: Ints, rows: Ints, count: int) -> Ints:
    slots = np.full(count, -1)
    slots[kept] = np.arange(len(kept))
    return np.asarray(slots[rows])
