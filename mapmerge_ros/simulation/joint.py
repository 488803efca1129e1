# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The full bundle over all robots' observations: the gold standard that merging is held to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapmerge_ros.arrays import Ids, Ints
from mapmerge_ros.bundle import Bundle
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.simulation.fleet import Fleet
from mapmerge_ros.submap import Descriptors


def joint_bundle(fleet: Fleet) -> Bundle:
    """
    Observations of the whole fleet as one bundle in the world frame, not adjusted.

    It starts from the robots' own maps, put together by the true frames. Point ids are those of
    the scene.
    """
    truth = fleet.truth
    return join(fleet.bundles, truth.S_world_map, truth.landmark_ids)


def join(
    bundles: Sequence[Bundle],
    S_world_maps: Sequence[Similarity],
    landmark_ids: Sequence[Ids],
) -> Bundle:
    """
    Several bundles as one, not adjusted: points of equal landmark id become one point.

    `landmark_ids` holds for each bundle the id (n,) of each of its points; a point of several
    bundles starts at the mean of theirs.
    """
    placed = [
        bundle.transformed(S_world_map)
        for bundle, S_world_map in zip(bundles, S_world_maps, strict=True)
    ]
    ids, rows = np.unique(np.concatenate(landmark_ids), return_inverse=True)
    counts = np.bincount(rows)
    points = np.concatenate([bundle.points for bundle in placed])
    sums = [np.bincount(rows, weights=axis) for axis in points.T]
    first_point = _offsets([len(bundle.point_ids) for bundle in placed])
    first_keyframe = _offsets([len(bundle.keyframe_ids) for bundle in placed])
    first_camera = _offsets([len(bundle.intrinsics) for bundle in placed])
    return replace(
        placed[0],
        intrinsics=np.concatenate([b.intrinsics for b in placed]),
        keyframe_ids=np.arange(sum(len(b.keyframe_ids) for b in placed), dtype=np.uint64),
        keyframe_cameras=_shifted([b.keyframe_cameras for b in placed], first_camera),
        rotations_camera_map=np.concatenate([b.rotations_camera_map for b in placed]),
        translations_camera_map=np.concatenate([b.translations_camera_map for b in placed]),
        point_ids=ids,
        points=np.column_stack(sums) / counts[:, None],
        observation_keyframes=_shifted([b.observation_keyframes for b in placed], first_keyframe),
        observation_points=rows[_shifted([b.observation_points for b in placed], first_point)],
        observations_px=np.concatenate([b.observations_px for b in placed]),
        descriptors=Descriptors.none(len(ids)),
    )


def _offsets(counts: list[int]) -> Ints:
    return np.cumsum([0, *counts[:-1]])


def _shifted(rows: list[Ints], offsets: Ints) -> Ints:
    return np.concatenate([own + offset for own, offset in zip(rows, offsets, strict=True)])
