# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The frame a robot happens to choose, and how to keep a map in it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mapmerge_ros.arrays import Floats
from mapmerge_ros.bundle import Bundle, FramePrior
from mapmerge_ros.geometry import Gauge, Similarity
from mapmerge_ros.geometry.rotations import as_rotation

SCALE_RANGE = (0.5, 2.0)
"""Map units per metre of a monocular map: whatever its first baseline was."""

OFFSET_STD = 10.0
"""Where a robot puts its origin [m]; far enough that nobody can mistake the frame for another."""


def random_frame(rng: np.random.Generator, gauge: Gauge) -> Similarity:
    """Frame S_map_world of the group of `gauge`, drawn at random."""
    if gauge is Gauge.NONE:
        return Similarity.identity()
    scale, rotation = 1.0, Rotation.from_quat(rng.normal(size=4)).as_matrix()
    if gauge is Gauge.SIMILARITY:
        scale = float(np.exp(rng.uniform(*np.log(SCALE_RANGE))))
    if gauge is Gauge.YAW_TRANSLATION:
        rotation = Rotation.from_euler('z', rng.uniform(-np.pi, np.pi)).as_matrix()
    return Similarity(scale, rotation, OFFSET_STD * rng.normal(size=3))


def frame_error(
    rng: np.random.Generator, gauge: Gauge, prior: FramePrior, centre: Floats
) -> Similarity:
    """
    By how much a robot errs in what its gauge claims to know, about `centre` (3,).

    Drawn from the very prior that compression writes into R: without it a merge of metric maps
    would be better than its evidence says.
    """
    draws = rng.normal(size=7)
    g = int(gauge)
    turn = np.zeros(3)
    turn[:2] = prior.gravity_std_rad * draws[1:3] * (g <= 4)
    turn[2] = prior.heading_std_rad * draws[3] * (g == 0)
    scale = float(np.exp(prior.scale_std_ratio * draws[0] * (g <= 6)))
    rotation = Rotation.from_rotvec(turn).as_matrix()
    shift = prior.position_std * draws[4:] * (g == 0)
    return Similarity(scale, rotation, centre + shift - scale * rotation @ centre)


def anchored(bundle: Bundle, reference: Bundle) -> Bundle:
    """
    Return `bundle` in the frame of `reference`, two states of the same key frames.

    Mean position, mean rotation and extent of the poses become those of the reference: the
    quantities that the rows of the frame prior are about (see `bundle.linearise`).
    """
    turns = reference.rotations_camera_map.transpose(0, 2, 1) @ bundle.rotations_camera_map
    rotation = as_rotation(turns).mean().as_matrix()
    centres, wanted = bundle.centres_map(), reference.centres_map()
    turned = (centres - centres.mean(axis=0)) @ rotation.T
    extent = float(np.sum(turned**2))
    overlap = float(np.sum(turned * (wanted - wanted.mean(axis=0))))
    scale = overlap / extent if overlap > 0.0 else 1.0
    shift = wanted.mean(axis=0) - scale * rotation @ centres.mean(axis=0)
    return bundle.transformed(Similarity(scale, rotation, shift))
