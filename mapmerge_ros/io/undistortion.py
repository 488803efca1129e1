# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pixels of any COLMAP camera model as those of an ideal pinhole."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from mapmerge_ros.arrays import Floats

ROUND_TRIP_PX: Final = 0.01
"""
Error of distorting an undistorted pixel again, up to which it counts as undistorted.

Beyond the edge of a lens model pycolmap returns finite nonsense; inside it is right to 1e-6.
"""

MAX_STRETCH: Final = 4.0
"""
Growth of a pixel's noise by undistortion, up to which the observation is used.

All observations weigh alike; 75 degrees off a fisheye's axis noise grows 15-fold, and a few such
points would rule the fit. 4 is reached at 60 degrees.
"""


def undistorted(camera: Any, pixels: Floats) -> Floats:
    """Pixels (n, 2) of the pinhole with the same focal lengths and centre; NaN = it has none."""
    if camera.model_name in ('PINHOLE', 'SIMPLE_PINHOLE') or not len(pixels):
        return pixels
    centre_px = np.array([camera.principal_point_x, camera.principal_point_y])
    outward = pixels - centre_px
    outward[~outward.any(axis=1)] = 1.0, 0.0
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    ideal = _ideal(camera, pixels)
    stretch = np.linalg.norm(_ideal(camera, pixels + outward) - ideal, axis=1)
    ideal[~(stretch <= MAX_STRETCH)] = np.nan
    return ideal


def _ideal(camera: Any, pixels: Floats) -> Floats:
    bearings: Floats = camera.cam_from_img(pixels)
    rows = np.flatnonzero(np.isfinite(bearings).all(axis=1))
    rays = np.column_stack([bearings[rows], np.ones(len(rows))])
    error = np.linalg.norm(camera.img_from_cam(rays) - pixels[rows], axis=1)
    bearings[rows[~(error <= ROUND_TRIP_PX)]] = np.nan
    focal_px = np.array([camera.focal_length_x, camera.focal_length_y])
    centre_px = np.array([camera.principal_point_x, camera.principal_point_y])
    ideal: Floats = focal_px * bearings + centre_px
    return ideal
