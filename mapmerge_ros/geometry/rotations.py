# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rotation matrices as SciPy has rotations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mapmerge_ros.arrays import Floats


def as_rotation(matrices: Floats) -> Rotation:
    """Rotation of matrices (..., 3, 3); they may be read-only, which SciPy 1.11 does not take."""
    return Rotation.from_matrix(np.array(matrices))
