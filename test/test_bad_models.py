# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""COLMAP models that are broken, or nothing that a pinhole could see: one line."""

from __future__ import annotations

import builtins
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from colmap_models import synthetic, write

from mapmerge_ros.io import MissingExtraError, ModelError, load_colmap

pycolmap = pytest.importorskip('pycolmap', reason='the extra colmap is not installed')


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
