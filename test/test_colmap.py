# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""COLMAP models: the same bundle from any camera model and either format, or one line."""

from __future__ import annotations

import builtins
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from submaps import real_model

from mapmerge_ros.bundle import Bundle, MapName, compress, linearise
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io import MissingExtraError, ModelError, load_colmap
from mapmerge_ros.io.undistortion import undistorted
from mapmerge_ros.submap import DescriptorType

pycolmap = pytest.importorskip('pycolmap', reason='the extra colmap is not installed')

CAMERAS = {
    'PINHOLE': [900.0, 880.0, 512.0, 380.0],
    'SIMPLE_PINHOLE': [900.0, 512.0, 384.0],
    'SIMPLE_RADIAL': [900.0, 512.0, 384.0, -0.1],
    'OPENCV': [900.0, 890.0, 512.0, 384.0, -0.2, 0.05, 1e-3, -2e-3],
    'OPENCV_FISHEYE': [500.0, 510.0, 512.0, 384.0, 0.02, -0.01, 1e-3, 0.0],
    'FOV': [700.0, 700.0, 512.0, 384.0, 0.5],
}


def synthetic(camera: str = 'SIMPLE_RADIAL', seed: int = 0) -> Any:
    """A model without noise."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 1, 4
    options.num_points3D = 60
    options.camera_model_id = getattr(pycolmap.CameraModelId, camera)
    options.camera_params = CAMERAS[camera]
    return pycolmap.synthesize_dataset(options)


def write(model: Any, folder: Path, suffix: str = 'bin') -> Path:
    folder.mkdir(exist_ok=True)
    model.write_text(folder) if suffix == 'txt' else model.write_binary(folder)
    return folder


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


SIFT = np.zeros((3, 128), np.uint8)
BAD_DESCRIPTORS: dict[str, tuple[dict[str, Any], str]] = {
    'names': ({'ids': [1]}, 'point_id or descriptors is missing'),
    'size': ({'point_id': [1, 2, 3], 'descriptors': SIFT[:, :100]}, 'got uint8 [3, 100]'),
    'type': ({'point_id': [1, 2, 3], 'descriptors': SIFT * 1.0}, 'got float64 [3, 128]'),
    'ids': ({'point_id': [1.0, 2.0, 3.0], 'descriptors': SIFT}, 'got float64 [3]'),
    'count': ({'point_id': [1, 2], 'descriptors': SIFT}, '3 rows, point_id: 2'),
    'twice': ({'point_id': [1, 2, 2], 'descriptors': SIFT}, 'an id appears twice'),
    'others': ({'point_id': [10**7, 0, 10**8], 'descriptors': SIFT}, 'none of the points'),
    'none': ({'point_id': np.zeros(0, int), 'descriptors': SIFT[:0]}, 'none of the points'),
    'objects': ({'point_id': [1, 2, 3], 'descriptors': [None, 1, 2]}, 'not an .npz file'),
}


@pytest.mark.parametrize('case', BAD_DESCRIPTORS)
def test_bad_descriptors_are_one_line(tmp_path: Path, case: str) -> None:
    arrays, reason = BAD_DESCRIPTORS[case]
    folder = write(synthetic(), tmp_path)
    path: Any = folder / 'descriptors.npz'
    np.savez(path, **{name: np.asarray(values) for name, values in arrays.items()})  # type: ignore
    with pytest.raises(ModelError) as caught:
        load_colmap(folder)
    assert str(caught.value).startswith(f'{folder / "descriptors.npz"}: ')
    assert reason in str(caught.value)


def test_damaged_descriptors_are_one_line(tmp_path: Path) -> None:
    folder = write(synthetic(), tmp_path)
    path = folder / 'descriptors.npz'
    np.savez_compressed(path, point_id=[1, 2, 3], descriptors=np.random.default_rng(0).bytes(384))
    data = path.read_bytes()
    for length in range(0, len(data), 37):
        path.write_bytes(data[:length])
        with pytest.raises(ModelError, match=r'descriptors\.npz: '):
            load_colmap(folder)


@pytest.mark.parametrize('name', ['cameras', 'images', 'points3D', 'rigs', 'frames'])
def test_a_truncated_binary_never_reaches_the_library(tmp_path: Path, name: str) -> None:
    """Cut short, points3D.bin makes pycolmap loop for ever; others load as garbage."""
    path = write(synthetic(), tmp_path) / f'{name}.bin'
    data = path.read_bytes()
    for length in {0, 1, 8, 9, len(data) // 2, len(data) - 8, len(data) - 1}:
        path.write_bytes(data[:length])
        with pytest.raises(ModelError, match=r'truncated or damaged|too many') as caught:
            load_colmap(tmp_path)
        assert str(caught.value).startswith(f'{path}: ')
    path.write_bytes(data + b'\0')
    with pytest.raises(ModelError, match='1 bytes too many'):
        load_colmap(tmp_path)


@pytest.mark.parametrize('name', ['cameras', 'images', 'points3D'])
@pytest.mark.parametrize('share', [0.0, 0.4, 0.8])
def test_a_truncated_text_is_one_line(tmp_path: Path, name: str, share: float) -> None:
    path = write(synthetic(), tmp_path, 'txt') / f'{name}.txt'
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ModelError) as caught:
        load_colmap(tmp_path)
    assert str(caught.value).startswith(f'{tmp_path}: ')
    assert '\n' not in str(caught.value)


def test_a_text_model_that_lost_points_is_noticed(tmp_path: Path) -> None:
    """The library loads it without a word."""
    path = write(synthetic(), tmp_path, 'txt') / 'points3D.txt'
    path.write_text(''.join(path.read_text().splitlines(keepends=True)[:-5]))
    with pytest.raises(ModelError, match='points3D lacks 5 points'):
        load_colmap(tmp_path)


def nothing(folder: Path) -> Path:
    return folder / 'nowhere'


def a_file(folder: Path) -> Path:
    (folder / 'x').touch()
    return folder / 'x'


def two_missing(folder: Path) -> Path:
    (folder / 'cameras.bin').touch()
    return folder


def deeper(folder: Path) -> Path:
    (folder / 'sparse' / '0').mkdir(parents=True)
    return folder


def without_points(folder: Path) -> Path:
    model = synthetic()
    model.delete_all_points2D_and_points3D()
    return write(model, folder)


def unseen_points(folder: Path) -> Path:
    model = synthetic('PINHOLE')
    for point in model.points3D.values():
        point.xyz = [np.nan] * 3
    return write(model, folder)


def panorama(folder: Path) -> Path:
    folder = write(synthetic('PINHOLE'), folder, 'txt')
    lines = (folder / 'cameras.txt').read_text().splitlines()
    kept = [line for line in lines if line.startswith('#')]
    cameras = [line.split() for line in lines if not line.startswith('#')]
    kept += [f'{camera[0]} EQUIRECTANGULAR 1024 768 1024 768' for camera in cameras]
    (folder / 'cameras.txt').write_text('\n'.join(kept) + '\n')
    return folder


BAD_MODELS: dict[str, tuple[Callable[[Path], Path], str]] = {
    'nothing': (nothing, 'no such folder: check the path'),
    'file': (a_file, 'no such folder'),
    'empty': (
        lambda folder: folder,
        'not a COLMAP model: cameras.bin, images.bin, points3D.bin missing: give the folder',
    ),
    'missing': (two_missing, 'not a COLMAP model: images.bin, points3D.bin missing'),
    'deeper': (
        deeper,
        'not a COLMAP model: cameras.bin, images.bin, points3D.bin missing: did you mean',
    ),
    'points': (without_points, 'a model without points'),
    'unseen': (unseen_points, 'observations: no point is seen in front of two key frames'),
}


@pytest.mark.parametrize('case', BAD_MODELS)
def test_bad_models_are_one_line(tmp_path: Path, case: str) -> None:
    make, reason = BAD_MODELS[case]
    folder = make(tmp_path)
    with pytest.raises(ModelError) as caught:
        load_colmap(folder)
    assert str(caught.value).startswith(f'{folder}: {reason}')
    assert '\n' not in str(caught.value)


@pytest.mark.skipif(
    not hasattr(pycolmap.CameraModelId, 'EQUIRECTANGULAR'), reason='this pycolmap has none'
)
def test_a_panorama_is_refused_and_takes_nothing_down(tmp_path: Path) -> None:
    """In a process of its own: asked for a focal length, pycolmap 4.2 ends with SIGSEGV."""
    code = f'from mapmerge_ros.io import load_colmap; load_colmap({str(panorama(tmp_path))!r})'
    run = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=False)
    assert run.returncode == 1, run.stderr
    assert 'EQUIRECTANGULAR' in run.stderr.splitlines()[-1]


def test_missing_extra_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real_import = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == 'pycolmap':
            raise ImportError(name)
        return real_import(name, *args, **kwargs)

    monkeypatch.setattr(builtins, '__import__', without)
    with pytest.raises(MissingExtraError, match=r'pip install mapmerge_ros\[colmap\]'):
        load_colmap(tmp_path)


def test_an_unreadable_file_is_one_line(tmp_path: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip('root may read everything')
    path = write(synthetic(), tmp_path) / 'images.bin'
    path.chmod(0)
    with pytest.raises(ModelError, match='Permission denied'):
        load_colmap(tmp_path)


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
