# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which of a bundle's lenses can be nuisance, and how much the calibration is believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.bundle.bundle import Bundle
from mapmerge_ros.bundle.lens import COUNT, Lens, displacements
from mapmerge_ros.bundle.linearise import linearise
from mapmerge_ros.errors import InvalidValue

MIN_KEYFRAMES = 3
"""Images of one camera that tell its lens from their poses; one image cannot."""

MAX_LENSES = 8
"""A robot's rig; hundreds of cameras are a photo collection, and 7 dense columns each."""


def with_lens_prior(bundle: Bundle, prior_px: float) -> Bundle:
    """
    Return the bundle with its shared intrinsics known to `prior_px` only; 0 = exactly.

    The prior is the standard deviation of each of the seven parameters, as the displacement that
    it causes, root mean square over the observations. Where σ is unknown the bundle's own stands
    in, once: the prior's weight stays what it is when the bundle moves. Cameras of fewer than
    three key frames stay as they are; look at `lens.cameras` for those that did not.

    Raises
    ------
    InvalidValue
        The prior is negative or not finite.

    """
    if not (np.isfinite(prior_px) and prior_px >= 0.0):
        raise InvalidValue(f'lens prior: {prior_px} is not a finite, non-negative number')
    calibrated = replace(bundle, lens=Lens())
    cameras = shared_cameras(bundle)
    if prior_px == 0.0 or not len(cameras):
        return calibrated
    sigma_px = bundle.sigma_px or _noise_px(calibrated)
    lens = Lens(
        cameras=cameras,
        scales=_scales(bundle, cameras),
        moved_px=np.zeros((len(cameras), COUNT)),
        weight=sigma_px / prior_px,
    )
    return replace(bundle, lens=lens)


def shared_cameras(bundle: Bundle) -> Ints:
    """Rows of the cameras that enough key frames have in common, ascending."""
    uses = np.bincount(bundle.keyframe_cameras, minlength=len(bundle.intrinsics))
    most = np.argsort(-uses, kind='stable')[:MAX_LENSES]
    return np.sort(most[uses[most] >= MIN_KEYFRAMES])


def _noise_px(bundle: Bundle) -> float:
    """Standard deviation of one residual, from all of them; exact data counts as 1e-3 px."""
    redundancy = max(bundle.residual_count - bundle.dof, 1)
    return max(float(np.sqrt(linearise(bundle).cost_px2 / redundancy)), 1e-3)


def _scales(bundle: Bundle, cameras: Ints) -> Floats:
    """Parameter (l, 7) that displaces the observations by 1 px root mean square."""
    of_observation = bundle.keyframe_cameras[bundle.observation_keyframes]
    scales = np.empty((len(cameras), COUNT))
    for slot, camera in enumerate(cameras):
        intrinsics = bundle.intrinsics[camera]
        pixels = bundle.observations_px[of_observation == camera]
        bearings = (pixels - intrinsics[2:]) / intrinsics[:2]
        focal_px = np.broadcast_to(intrinsics[:2], bearings.shape)
        moved = np.sum(displacements(bearings, focal_px) ** 2, axis=1)
        scales[slot] = 1.0 / np.sqrt(np.mean(moved, axis=0))
    return scales
