# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Bundles as messages: what goes out comes back; what nothing determines is pruned."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from submaps import assert_same, random_bundle

from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io import (
    InvalidMessage,
    bundle_from_message,
    bundle_to_message,
    create,
    decode_bundle,
    encode_bundle,
)


@pytest.mark.parametrize('gauge', list(Gauge))
def test_bundle_survives(gauge: Gauge) -> None:
    named = random_bundle(np.random.default_rng(7), gauge)
    decoded = decode_bundle(encode_bundle(named))
    assert_same(decoded.bundle, named.bundle)
    assert decoded.name == named.name
    assert decoded.keyframe_stamps_ns == named.keyframe_stamps_ns
    assert encode_bundle(decoded) == encode_bundle(named)


def bundle_message(**changes: Any) -> Any:
    message = bundle_to_message(random_bundle(np.random.default_rng(8)), create)
    for name, value in changes.items():
        setattr(message, name, value(getattr(message, name)) if callable(value) else value)
    return message


def test_what_nothing_determines_is_pruned() -> None:
    message = bundle_message()
    message.keyframe_ids = np.append(message.keyframe_ids, np.uint64(99))  # sees two points only
    message.keyframe_cameras = np.append(message.keyframe_cameras, np.uint32(0))
    message.keyframe_stamps = [*message.keyframe_stamps, message.keyframe_stamps[0]]
    message.poses = np.append(message.poses, [0, 0, 0, 1, 0, 0, 0.0])
    lonely, behind = [0.0, 0.0, 8.0], [0.0, 0.0, -8.0]
    message.point_ids = np.append(message.point_ids, np.array([500, 501], np.uint64))
    message.points = np.append(message.points, lonely + behind)
    message.descriptors = np.append(
        message.descriptors, np.zeros(2 * message.descriptor_size, np.uint8)
    )
    extra = [(5, 0), (5, 1), (0, 12), (0, 13), (1, 13), (0, 0)]  # the last one is there already
    columns = np.array(extra, np.uint32).T
    message.observation_keyframes = np.append(message.observation_keyframes, columns[0])
    message.observation_points = np.append(message.observation_points, columns[1])
    message.observations = np.append(message.observations, np.zeros(12, np.float32))
    expected = random_bundle(np.random.default_rng(8))
    received = bundle_from_message(message)
    assert_same(received.bundle, expected.bundle)
    assert received.keyframe_stamps_ns == expected.keyframe_stamps_ns


def test_nearly_unit_quaternion_is_normalised() -> None:
    expected = random_bundle(np.random.default_rng(8)).bundle
    stretched = bundle_message(poses=lambda poses: poses * np.tile([1.0009] * 4 + [1] * 3, 5))
    turns = bundle_from_message(stretched).bundle.rotations_camera_map
    np.testing.assert_allclose(turns, expected.rotations_camera_map, atol=1e-12)


BAD_BUNDLES: dict[str, tuple[dict[str, Any], str]] = {
    'quaternion': ({'poses': lambda poses: poses * 1.01}, 'poses: quaternion 0 has length 1.01'),
    'zero quaternion': ({'poses': np.zeros(35)}, 'poses: quaternion 0 has length 0'),
    'poses': ({'poses': np.zeros(34)}, 'poses: expected 7 x 5 values, got 34'),
    'pose nan': ({'poses': np.full(35, np.nan)}, 'poses: value 0 is not finite'),
    'camera': ({'keyframe_cameras': np.full(5, 1, np.uint32)}, 'keyframe_cameras: row 1 of 1'),
    'frame': (
        {'observation_keyframes': lambda rows: rows + np.uint32(1)},
        'observation_keyframes: row 5 of 5',
    ),
    'point': ({'observation_points': lambda rows: rows * 2}, 'observation_points: row 22 of 12'),
    'observations': (
        {'observations': lambda pixels: pixels[:-2]},
        'observation_keyframes: expected 1 x 59 values, got 60',
    ),
    'pixel nan': (
        {'observations': np.full(120, np.nan, np.float32)},
        'observations: value 0 is not finite',
    ),
    'points': ({'points': np.zeros(35)}, 'points: expected 3 x 12'),
    'point ids': ({'point_ids': np.ones(12, np.uint64)}, 'point_ids: an id appears twice'),
    'stamps': ({'keyframe_stamps': []}, 'keyframe_stamps: 0 for 5 ids'),
    'intrinsics': ({'intrinsics': np.zeros(4)}, 'intrinsics: a focal length is not positive'),
    'gauge': ({'gauge': 3}, 'gauge: 3 is none of'),
    'scale prior': ({'gauge': 6, 'scale_std_ratio': 0.0}, 'scale_std_ratio: 0.0'),
    'sigma': ({'sigma': -1.0}, 'sigma_px: -1.0'),
    'nothing': (
        {
            'observations': np.zeros(0, np.float32),
            'observation_keyframes': np.zeros(0, np.uint32),
            'observation_points': np.zeros(0, np.uint32),
        },
        'observations: no point is seen',
    ),
    'name': ({'map_id': ''}, 'map_id: empty'),
}


@pytest.mark.parametrize('case', BAD_BUNDLES)
def test_bad_bundle_is_refused_by_field(case: str) -> None:
    changes, reason = BAD_BUNDLES[case]
    with pytest.raises(InvalidMessage) as caught:
        bundle_from_message(bundle_message(**changes))
    name = changes.get('map_id', 'drone1/0001')
    assert str(caught.value).startswith(f'bundle {name!r}: {reason}')


def test_priors_count_only_where_the_gauge_uses_them() -> None:
    assert bundle_from_message(bundle_message(scale_std_ratio=0.0, gravity_std_rad=0.0))
    rigid = bundle_from_message(bundle_message(gauge=6, scale_std_ratio=0.5, gravity_std_rad=0.0))
    assert rigid.bundle.prior.scale_std_ratio == 0.5
