# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How large a cloud of points is."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Floats


def scene_radius(points: Floats) -> float:
    """Median distance of points (n, 3) from their median: a few far ones do not count."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
