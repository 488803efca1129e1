# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Everything else of a bundle after its shared points have moved (eq. 4 of the paper)."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.bundle.bundle import Bundle
from mapmerge_ros.bundle.linearise import Linearisation

Steps = tuple[Floats, Floats, Floats]
"""Of poses (m, 6), points (n, 3) and lenses (l, 7): what `Elimination.steps` gives"""


def follow(lin: Linearisation, shared_rows: Ints, steps: Steps) -> Bundle:
    """
    Bundle after steps in which everything follows the shared points, linearly.

    A private point of hardly any parallax may answer with a step to behind a camera that observes
    it; such a point goes where its cameras carry it.

    Raises
    ------
    InvalidValue
        A shared point would be behind a camera that observes it.

    """
    pose_steps, point_steps, lens_steps = steps
    carried = _carried(lin.bundle, shared_rows, pose_steps, point_steps)
    return lin.moved(pose_steps, carried, lens_steps)


def behind(bundle: Bundle, pose_steps: Floats, point_steps: Floats) -> Ints:
    """Rows of the points that such steps take behind a camera that observes them."""
    rotations, translations = _poses(bundle, pose_steps)
    moved = (bundle.points + point_steps)[bundle.observation_points]
    depths = np.einsum('oj,oj->o', rotations[:, 2], moved) + translations[:, 2]
    return np.unique(bundle.observation_points[depths <= 0.0])


def _carried(bundle: Bundle, shared_rows: Ints, pose_steps: Floats, point_steps: Floats) -> Floats:
    """Steps (n, 3); private points that would be behind a camera go with those that see them."""
    rotations, translations = _poses(bundle, pose_steps)
    places = np.einsum('oji,oj->oi', rotations, bundle.points_camera() - translations)
    carried = point_steps.copy()
    for row in np.setdiff1d(behind(bundle, pose_steps, point_steps), shared_rows):
        own = bundle.observation_points == row
        carried[row] = places[own].mean(axis=0) - bundle.points[row]
    return carried


def _poses(bundle: Bundle, pose_steps: Floats) -> tuple[Floats, Floats]:
    """Rotations (o, 3, 3) and translations (o, 3) of the observing cameras after such steps."""
    turns = Rotation.from_rotvec(pose_steps[:, :3]).as_matrix()
    rotations = turns @ bundle.rotations_camera_map
    translations = bundle.translations_camera_map + pose_steps[:, 3:]
    return rotations[bundle.observation_keyframes], translations[bundle.observation_keyframes]
