# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Sessions compressed beside one dense QR of everything."""

from __future__ import annotations

import numpy as np
from merge_steps import Values, timed
from workloads import sessions

from mapmerge_ros.arrays import Ids
from mapmerge_ros.bundle import Bundle, MapName, compress


def compression(repeats: int) -> Values:
    """Sessions compressed as they are shipped, each beside one dense QR of everything."""
    return {
        'choices': [
            {'choice': choice, **_compressed(drone, ids, repeats)}
            for choice, (drone, ids) in sessions().items()
        ]
    }


def _compressed(drone: Bundle, ids: Ids, repeats: int) -> Values:
    name = MapName('session/0001', 'session')
    took, fast = timed(repeats, lambda _: compress(drone, name, ids, catalogue=False, dtype=float))
    dense_took, plain = timed(
        1,
        lambda _: compress(drone, name, ids, catalogue=False, method='dense', dtype=float),
    )
    expected = plain.triangle().T @ plain.triangle()
    difference = np.abs(fast.triangle().T @ fast.triangle() - expected).max()
    return {
        **took,
        'dense_cpu_s': dense_took['cpu_s'],
        'difference': float(difference / np.abs(expected).max()),
        'keyframes': len(drone.keyframe_ids),
        'points': len(drone.point_ids),
        'landmarks': len(ids),
    }
