# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""COLMAP models: the same bundle from any camera model and either format, or one line."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from colmap_models import CAMERAS, synthetic, write
from submaps import real_model

from mapmerge_ros.bundle import Bundle, MapName, compress, linearise
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io import load_colmap
from mapmerge_ros.io.undistortion import undistorted
from mapmerge_ros.submap import DescriptorType

pycolmap = pytest.importorskip('pycolmap', reason='the extra colmap is not installed')


@pytest.mark.parametrize('suffix', ['bin', 'txt'])
@pytest.mark.parametrize('camera', CAMERAS)
def test_any_camera_becomes_a_pinhole(tmp_path: Path, camera: str, suffix: str) -> None:
    model = synthetic(camera)
    bundle = load_colmap(write(model, tmp_path, suffix))
    assert np.abs(linearise(bundle).residuals_px).max() < 1e-6
    assert len(bundle.observations_px) == model.compute_num_observations()
    first = model.cameras[min(model.cameras)]
    np.testing.assert_allclose(
        bundle.intrinsics[0],
        [
            first.focal_length_x,
            first.focal_length_y,
            first.principal_point_x,
            first.principal_point_y,
        ],
    )


def test_ids_are_those_of_the_model(tmp_path: Path) -> None:
    model = synthetic()
    bundle = load_colmap(write(model, tmp_path), Gauge.RIGID)
    assert bundle.gauge is Gauge.RIGID
    assert bundle.keyframe_ids.tolist() == sorted(model.reg_image_ids())
    assert bundle.point_ids.tolist() == sorted(model.point3D_ids())
    for row, key in enumerate(bundle.keyframe_ids):
        pose = model.images[int(key)].cam_from_world().matrix()
        np.testing.assert_allclose(bundle.rotations_camera_map[row], pose[:, :3])
        np.testing.assert_allclose(bundle.translations_camera_map[row], pose[:, 3])
    for row, key in enumerate(bundle.point_ids):
        np.testing.assert_array_equal(bundle.points[row], model.points3D[int(key)].xyz)


def same(left: Bundle, right: Bundle) -> None:
    for name in ('keyframe_ids', 'point_ids', 'observation_keyframes', 'observation_points'):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name))
    for name in ('points', 'observations_px', 'rotations_camera_map', 'translations_camera_map'):
        np.testing.assert_allclose(getattr(left, name), getattr(right, name), atol=1e-9)


def test_text_and_binary_are_the_same(tmp_path: Path) -> None:
    model = synthetic('OPENCV')
    text = load_colmap(write(model, tmp_path / 'a', 'txt'))
    same(load_colmap(write(model, tmp_path / 'b')), text)


def test_models_without_rigs_are_read(tmp_path: Path) -> None:
    """COLMAP before 3.12 knows no rigs.bin and no frames.bin."""
    folder = write(synthetic(), tmp_path)
    expected = load_colmap(folder)
    (folder / 'rigs.bin').unlink()
    (folder / 'frames.bin').unlink()
    same(load_colmap(folder), expected)


def test_what_nothing_determines_is_left_out(tmp_path: Path) -> None:
    model = synthetic('PINHOLE')
    keys = sorted(model.point3D_ids())
    behind = keys[3]
    image = model.images[min(model.reg_image_ids())]
    centre, axis = image.projection_center(), image.viewing_direction()
    model.points3D[behind].xyz = centre - 5.0 * axis
    last = model.images[max(model.reg_image_ids())]
    seen = [row for row, point in enumerate(last.points2D) if point.has_point3D()]
    for row in seen[2:]:
        model.delete_observation(last.image_id, row)
    bundle = load_colmap(write(model, tmp_path))
    assert last.image_id not in bundle.keyframe_ids
    assert (bundle.points_camera()[:, 2] > 0.0).all()
    pairs = np.stack([bundle.observation_points, bundle.observation_keyframes], axis=1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)


@pytest.mark.parametrize('camera', ['OPENCV_FISHEYE', 'FOV'])
def test_observations_that_no_pinhole_has_are_dropped(tmp_path: Path, camera: str) -> None:
    """The library undistorts them to finite nonsense."""
    model = synthetic(camera)
    expected = len(load_colmap(write(model, tmp_path / 'a')).observations_px)
    image = model.images[min(model.reg_image_ids())]
    row = next(row for row, point in enumerate(image.points2D) if point.has_point3D())
    image.points2D[row].xy = [1e5, 1e5]
    bundle = load_colmap(write(model, tmp_path / 'b'))
    assert len(bundle.observations_px) == expected - 1
    assert np.abs(linearise(bundle).residuals_px).max() < 1e-6


def test_undistortion_is_exact_and_does_not_amplify_noise() -> None:
    """An equidistant fisheye: angle = radius / focal length, known in closed form."""
    focal_px = 500.0
    camera = pycolmap.Camera(
        model='SIMPLE_FISHEYE', width=2000, height=2000, params=[focal_px, 1000.0, 1000.0]
    )
    angles = np.deg2rad([0.0, 10.0, 45.0, 59.0, 62.0, 80.0, 90.0, 100.0, 179.0])
    pixels = np.stack([1000.0 + focal_px * angles, np.full(9, 1000.0)], axis=1)
    found = undistorted(camera, pixels)
    np.testing.assert_allclose(found[:4, 0], 1000.0 + focal_px * np.tan(angles[:4]), atol=1e-6)
    assert np.isnan(found[4:]).all()


@pytest.mark.parametrize(
    ('size', 'kind'),
    [
        (128, DescriptorType.SIFT),
        (64, DescriptorType.BINARY),
        (48, DescriptorType.BINARY),
        (32, DescriptorType.BINARY),
    ],
)
def test_descriptors_follow_their_points(tmp_path: Path, size: int, kind: DescriptorType) -> None:
    model = synthetic()
    ids = np.random.default_rng(0).permutation(sorted(model.point3D_ids())).astype(np.int64)
    rows = np.random.default_rng(1).integers(1, 256, (len(ids), size), dtype=np.uint8)
    folder = write(model, tmp_path)
    np.savez(folder / 'descriptors.npz', point_id=ids[2:], descriptors=rows[2:])
    bundle = load_colmap(folder)
    assert bundle.descriptors.type is kind
    by_id = dict(zip(ids.tolist(), rows, strict=True))
    for row, key in zip(bundle.descriptors.rows, bundle.point_ids.tolist(), strict=True):
        expected = by_id[key] if key not in ids[:2] else np.zeros(size)
        np.testing.assert_array_equal(row, expected)


def test_without_the_file_there_are_no_descriptors(tmp_path: Path) -> None:
    assert load_colmap(write(synthetic(), tmp_path)).descriptors.type is DescriptorType.NONE


def test_real_session_loads_fast_and_compresses() -> None:
    folder = real_model('caliterra_drone/session_0')
    start = time.perf_counter()
    bundle = load_colmap(folder)
    assert time.perf_counter() - start < 2.0
    assert (len(bundle.keyframe_ids), len(bundle.points)) == (20, 14179)
    assert len(bundle.observations_px) == 65249
    assert bundle.descriptors.type is DescriptorType.SIFT
    assert bundle.descriptors.rows.any(axis=1).all()
    residuals = linearise(bundle).residuals_px
    assert np.median(np.abs(residuals)) < 1.0
    submap = compress(bundle, MapName('a', 'a'), bundle.point_ids[:100])
    assert submap.compressed_count == 100


@pytest.mark.parametrize('session', range(8))
def test_real_slam_maps_have_binary_descriptors(session: int) -> None:
    bundle = load_colmap(real_model(f'euroc_v101_maplab/session_{session}'))
    assert bundle.descriptors.type is DescriptorType.BINARY
    assert bundle.descriptors.size == 48
