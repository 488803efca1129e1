# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""COLMAP models as bundles (needs the extra `colmap`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints
from mapmerge_ros.bundle import Bundle
from mapmerge_ros.errors import InvalidValue, MapMergeError
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io.colmap_files import ModelError, check_files
from mapmerge_ros.io.descriptor_file import load_descriptors
from mapmerge_ros.io.raw_bundle import Pruned, RawBundle
from mapmerge_ros.io.undistortion import undistorted


class MissingExtraError(MapMergeError):
    """An optional package is not installed."""


def load_colmap(folder: str | Path, gauge: Gauge = Gauge.SIMILARITY) -> Bundle:
    """
    Bundle of a COLMAP model: `cameras images points3D` as .bin or .txt.

    `keyframe_ids` are its image ids, `point_ids` its point3D ids. Any camera model with a focal
    length becomes an ideal pinhole of the same focal length and principal point; observations
    are undistorted, see `undistortion`. `descriptors.npz` beside the files is optional, see
    `load_descriptors`. What nothing determines is left out, see `RawBundle.pruned`.

    Raises
    ------
    ModelError
        The folder does not hold a readable model with points.
    MissingExtraError
        pycolmap is not installed.

    """
    return read_colmap(folder, gauge).bundle


def read_colmap(folder: str | Path, gauge: Gauge = Gauge.SIMILARITY) -> Pruned:
    """
    Like `load_colmap`, with what was left out.

    Raises
    ------
    ModelError
        The folder does not hold a readable model with points.
    MissingExtraError
        pycolmap is not installed.

    """
    folder = Path(folder)
    model = _read(folder)
    cameras = [model.cameras[key] for key in sorted(model.cameras)]
    images = [model.images[key] for key in sorted(model.images) if model.images[key].has_pose]
    if not model.num_points3D():
        raise ModelError(f'{folder}: a model without points: triangulate it first')
    points = sorted(model.points3D.items())
    point_ids = np.array([key for key, _ in points], np.uint64)
    poses = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    intrinsics = np.array([_pinhole(folder, camera) for camera in cameras])
    frames, observed, pixels = _observations(images)
    raw = RawBundle(
        intrinsics=intrinsics,
        keyframe_ids=np.array([image.image_id for image in images], np.uint64),
        keyframe_cameras=np.searchsorted(
            [camera.camera_id for camera in cameras], [image.camera_id for image in images]
        ),
        rotations_camera_map=poses[:, :, :3],
        translations_camera_map=poses[:, :, 3],
        point_ids=point_ids,
        points=np.array([point.xyz for _, point in points]),
        observation_keyframes=frames,
        observation_points=_rows(folder, point_ids, observed),
        observations_px=pixels,
        descriptors=load_descriptors(folder / 'descriptors.npz', point_ids),
        gauge=gauge,
    )
    try:
        return raw.pruned()
    except InvalidValue as err:
        raise ModelError(f'{folder}: {err}') from err


def _read(folder: Path) -> Any:
    try:
        import pycolmap
    except ImportError as err:
        raise MissingExtraError(
            'COLMAP models need pycolmap: pip install mapmerge_ros[colmap]'
        ) from err

    def parameter_count(model: int) -> int:
        kind = pycolmap.CameraModelId(model)
        return len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1).params)

    check_files(folder, parameter_count)
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, IndexError, RuntimeError, TypeError, MemoryError) as err:
        reason = ' '.join(str(err).split())[:200]
        raise ModelError(
            f'{folder}: not a readable COLMAP model: {reason}: are cameras, images and points3D '
            'of one reconstruction?'
        ) from err


def _pinhole(folder: Path, camera: Any) -> list[float]:
    """Return fx fy cx cy [px]."""
    # Asked for its focal length, a panoramic camera takes the whole process down.
    if not camera.focal_length_idxs():
        raise ModelError(
            f'{folder}: camera {camera.camera_id}: {camera.model_name} has no focal length: '
            'cut its images into perspective views'
        )
    return [
        camera.focal_length_x,
        camera.focal_length_y,
        camera.principal_point_x,
        camera.principal_point_y,
    ]


def _observations(images: list[Any]) -> tuple[Ints, Ids, Floats]:
    """Row of the image, point3D id and undistorted pixel of every observation of a point."""
    frames, ids, pixels = [], [], []
    for row, image in enumerate(images):
        seen = [point for point in image.points2D if point.has_point3D()]
        ids.append(np.array([point.point3D_id for point in seen], np.uint64))
        frames.append(np.full(len(seen), row))
        distorted = np.array([point.xy for point in seen]).reshape(-1, 2)
        pixels.append(undistorted(image.camera, distorted))
    if not frames:
        return np.zeros(0, np.int64), np.zeros(0, np.uint64), np.zeros((0, 2))
    return np.concatenate(frames), np.concatenate(ids), np.concatenate(pixels)


def _rows(folder: Path, point_ids: Ids, observed: Ids) -> Ints:
    rows = np.minimum(np.searchsorted(point_ids, observed), len(point_ids) - 1)
    missing = len(np.unique(observed[point_ids[rows] != observed]))
    if missing:
        raise ModelError(
            f'{folder}: points3D lacks {missing} points that images observe: truncated or damaged'
        )
    return rows
