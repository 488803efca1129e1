# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fusions to be exported and reported: with maps that stay apart, with things that moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.fusion import Change, Fusion, Kind, fuse
from mapmerge_ros.geometry import Gauge, Similarity
from mapmerge_ros.submap import Descriptors, SubMap

from scenes import random_bundle  # isort: skip

SHARED_COUNT = 14
MOVED_COUNT = 6
SECTIONS = ('verdict', 'map', 'sub-maps', 'changes', 'test', 'links', 'cost')
"""Of a report about a merge, by their ids."""


def submaps(gauge: Gauge = Gauge.SIMILARITY) -> list[SubMap]:
    """Two maps of one scene, one of somewhere else and one that is only announced."""
    rng = np.random.default_rng(8)
    made = []
    for k, space in enumerate(('site', 'site', 'far', 'site')):
        bundle = random_bundle(seed=0, gauge=gauge, noise_px=0.3)
        frame = Similarity.exp(0.2 * rng.normal(size=7) * (gauge is Gauge.SIMILARITY))
        name = MapName(f'r{k}/0001', f'r{k}', k + 1, k, id_space=space)
        ids = np.sort(bundle.point_ids)[: SHARED_COUNT + k if k < 3 else 0]
        made.append(compress(bundle.transformed(frame), name, ids))
    return made


def moved_fusion() -> Fusion:
    """An object and a doubtful landmark, found by nobody: what is shown must not depend on it."""
    fusion = fuse(submaps())
    first = fusion.components[0]
    landmarks = first.landmarks
    size = np.linalg.norm(np.ptp(landmarks.points_global, axis=0))
    changes = tuple(
        Change(
            map_id='r1/0001',
            revision=2,
            landmark_id=k,
            global_id=int(landmarks.ids[k]),
            position_global=landmarks.points_global[k],
            displacement_global=size * np.array([0.03, 0.04, 0.0 if k < MOVED_COUNT else 0.05]),
            covariance=(0.004 * size) ** 2 * np.diag([1.0, 2.0, 9.0]),
            p_value=1e-15 if k < MOVED_COUNT else 2e-4,
            object_id=int(k < MOVED_COUNT),
            kind=Kind.MOVED if k < MOVED_COUNT else Kind.DOUBTFUL,
        )
        for k in range(MOVED_COUNT + 1)
    )
    return replace(fusion, components=(replace(first, changes=changes), *fusion.components[1:]))


def large_fusion(catalogue: int) -> Fusion:
    """Two sub-maps that announce `catalogue` landmarks each besides those that they share."""
    return fuse(_announcing(submap, catalogue, k) for k, submap in enumerate(submaps()[:2]))


def _announcing(submap: SubMap, count: int, number: int) -> SubMap:
    rng = np.random.default_rng(number)
    middle, spread = submap.points.mean(axis=0), submap.points.std(axis=0)
    more = middle + spread * rng.normal(size=(count, 3))
    ids = np.arange(count, dtype=np.uint64) + np.uint64(10**9 * (number + 1))
    total = len(submap.points) + count
    return replace(
        submap,
        landmark_ids=np.concatenate([submap.landmark_ids, ids]),
        points=np.concatenate([submap.points, more]),
        covariances=None,
        descriptors=Descriptors.none(total),
    )
