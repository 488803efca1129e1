# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Catalogues of one scene, without a bundle: what the choice of landmarks needs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mapmerge_ros.association import number_by_id
from mapmerge_ros.fusion.catalogues import Tracks
from mapmerge_ros.geometry import Gauge, Similarity
from mapmerge_ros.submap import Descriptors, Source, SubMap, packed_size

SCENE = np.random.default_rng(17).uniform([0.0, 0.0, 0.0], [100.0, 60.0, 8.0], (3000, 3))
"""Points of the scene [m]; the id of a landmark is its row."""


def catalogue(
    name: str, ids: Any, *, compressed: int = 0, revision: int = 1, seed: int = 0, **changes: Any
) -> SubMap:
    """Sub-map of some points of the scene in a frame of its own; the first are compressed."""
    rng = np.random.default_rng([seed, *name.encode()])
    ids = np.asarray(ids, np.uint64)
    rank = max(3 * compressed - 7, 0)
    frame = Similarity.exp(rng.normal(size=7))
    stds = frame.scale * rng.uniform(0.01, 0.1, len(ids))
    covariances = np.zeros((len(ids), 6))
    covariances[:, [0, 3, 5]] = stds[:, None] ** 2
    values: dict[str, Any] = {
        'map_id': name,
        'robot_id': name.partition('/')[0],
        'revision': revision,
        'stamp_ns': 0,
        'frame_id': name,
        'sources': (Source(name, revision),),
        'gauge': Gauge.SIMILARITY,
        'id_space': 'site',
        'landmark_ids': ids,
        'points': frame.apply(SCENE[ids.astype(np.int64)]),
        'covariances': covariances,
        'compressed_count': compressed,
        'a': 1.0,
        'packed_r': rng.normal(size=packed_size(rank, 3 * compressed)).astype(np.float32),
        'c': np.zeros(rank),
        'residual_count': 1000,
        'dof': 500,
        'sigma': 0.5,
        'descriptors': Descriptors.none(len(ids)),
    }
    return SubMap(**{**values, **changes})


def within(low: Sequence[float], high: Sequence[float], share: float = 1.0, seed: int = 0) -> Any:
    """Ids of the points of the scene in a rectangle; `share` of them."""
    inside = ((SCENE[:, :2] >= low) & (SCENE[:, :2] < high)).all(axis=1)
    kept = np.random.default_rng(seed).random(len(SCENE)) < share
    return np.flatnonzero(inside & kept)


def tracks_by_id(submaps: Sequence[SubMap]) -> Tracks:
    """Landmarks of equal id in the same id space are one track."""
    return Tracks(*number_by_id(submaps, [submap.landmark_ids for submap in submaps]))
