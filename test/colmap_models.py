# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""COLMAP models to read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

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
