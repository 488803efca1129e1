# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Random values for tests, and where the real data is."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapmerge_ros.bundle import Bundle, MapName
from mapmerge_ros.bundle.lens import Lens
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io import NamedBundle
from mapmerge_ros.submap import (
    Descriptors,
    DescriptorType,
    Source,
    SubMap,
    pack,
    upper_from_symmetric,
)

DATA = Path(__file__).resolve().parents[2] / 'shared' / 'data'

DESCRIPTORS = ((DescriptorType.NONE, 0), (DescriptorType.BINARY, 32), (DescriptorType.SIFT, 128))


def real_model(name: str) -> Path:
    """Folder of a real session; skips the test where the data is absent."""
    if not (DATA / name).is_dir():
        pytest.skip(f'real data not found: {DATA / name}')
    return DATA / name


def random_descriptors(rng: np.random.Generator, count: int) -> Descriptors:
    kind, size = DESCRIPTORS[int(rng.integers(len(DESCRIPTORS)))]
    return Descriptors(kind, rng.integers(0, 256, (count, size), dtype=np.uint8))


def random_submap(rng: np.random.Generator, **changes: Any) -> SubMap:
    """A valid sub-map with every field random; `changes` replace fields."""
    gauge = list(Gauge)[int(rng.integers(4))]
    n = int(rng.integers(4, 40))
    m = int(rng.integers(3, n + 1)) if rng.random() < 0.7 else 0
    rank, columns = max(3 * m - int(gauge), 0), 3 * m
    trapezoid = rng.normal(size=(rank, columns)) / max(columns, 1)
    np.fill_diagonal(trapezoid, rng.uniform(1.0, 2.0, rank))
    roots = rng.normal(size=(n, 3, 3))
    dof = int(rng.integers(10, 1000))
    map_id = f'drone{rng.integers(100)}/{rng.integers(10000):04d}'
    values: dict[str, Any] = {
        'map_id': map_id,
        'robot_id': 'Drohne 3 (müde)',
        'revision': int(rng.integers(2**32)),
        'stamp_ns': int(rng.integers(-(2**31) * 10**9, 2**31 * 10**9)),
        'frame_id': f'{map_id}/frame',
        'sources': tuple(Source(f'leaf{i}', int(rng.integers(2**32))) for i in range(3)),
        'gauge': gauge,
        'id_space': str(rng.choice(['', 'fleet'])),
        'landmark_ids': rng.choice(10**6, n, replace=False).astype(np.uint64) + 2**63,
        'points': rng.normal(size=(n, 3)),
        'covariances': (
            upper_from_symmetric(roots @ roots.swapaxes(1, 2)) if rng.random() < 0.5 else None
        ),
        'compressed_count': m,
        'a': float(rng.random()),
        'packed_r': pack(trapezoid).astype(np.float32),
        'c': (rng.normal(size=rank) * (rng.random() < 0.5)).astype(np.float32),
        'residual_count': dof + int(rng.integers(1, 1000)),
        'dof': dof,
        'sigma': float(rng.choice([0.0, 0.7])),
        'descriptors': random_descriptors(rng, n),
    }
    return SubMap(**{**values, **changes})


def small_submap() -> SubMap:
    return random_submap(
        np.random.default_rng(6),
        map_id='drone1/0001',
        gauge=Gauge.SIMILARITY,
        landmark_ids=np.arange(5),
        points=np.arange(15.0).reshape(5, 3),
        covariances=np.ones((5, 6)),
        compressed_count=4,
        packed_r=np.ones(5 * 12 - 10, np.float32),
        c=np.ones(5),
        descriptors=Descriptors(DescriptorType.BINARY, np.zeros((5, 32), np.uint8)),
    )


def random_bundle(rng: np.random.Generator, gauge: Gauge = Gauge.SIMILARITY) -> NamedBundle:
    """A bundle of 5 key frames that look down a corridor of 12 points, seen by all."""
    m, n = 5, 12
    points = rng.uniform([-2, -2, 6], [2, 2, 9], (n, 3))
    translations = rng.normal(size=(m, 3)) * 0.3
    frames, seen = (rows.ravel() for rows in np.indices((m, n)))
    in_camera = points[seen] + translations[frames]
    bundle = Bundle(
        intrinsics=np.array([[500.0, 510.0, 320.0, 240.0]]),
        keyframe_ids=np.arange(m, dtype=np.uint64) + 7,
        keyframe_cameras=np.zeros(m, np.int64),
        rotations_camera_map=np.broadcast_to(np.eye(3), (m, 3, 3)),
        translations_camera_map=translations,
        point_ids=np.arange(n, dtype=np.uint64) * 3 + 1,
        points=points,
        observation_keyframes=frames,
        observation_points=seen,
        observations_px=(500.0 * in_camera[:, :2] / in_camera[:, 2:] + 300.0).astype(np.float32),
        descriptors=random_descriptors(rng, n),
        gauge=gauge,
    )
    name = MapName('drone1/0001', 'drone1', 3, 1_700_000_000_123_456_789, 'drone1/map', 'fleet')
    return NamedBundle(name, bundle, tuple(range(10**9, 10**9 + m)))


def assert_same(left: Any, right: Any) -> None:
    """Field by field, bit by bit."""
    for field in fields(left):
        one, other = getattr(left, field.name), getattr(right, field.name)
        if isinstance(one, Descriptors):
            assert one.type is other.type
            one, other = one.rows, other.rows
        if isinstance(one, Lens):
            assert_same(one, other)
        elif isinstance(one, np.ndarray):
            assert one.dtype == other.dtype, field.name
            np.testing.assert_array_equal(one, other, err_msg=field.name)
        else:
            assert one == other, field.name
