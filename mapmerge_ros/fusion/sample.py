# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which tracks stand for all of them, where there are too many to fit errors to."""

from __future__ import annotations

import numpy as np
import scipy.sparse

from mapmerge_ros.arrays import Ints, Mask
from mapmerge_ros.fusion.quadratic import Members

LEAST_OF_A_MAP = 10
"""
Contrasts for each map in a sample, about: a frame explains two and a third, the others are left.
"""

NOBODY: Ints = np.zeros(0, np.int64)


def within_some_maps(members: Members, most: int, suspects: Ints) -> Mask:
    """Tracks (n,) that only some maps have: those of the suspects, and then the nearest ones."""
    count = int(members.maps.max()) + 1
    size = int(members.tracks.max()) + 1
    if count <= most:
        return np.ones(size, bool)
    has = scipy.sparse.csr_array((np.ones(len(members)), (members.maps, members.tracks)))
    shared = has @ has.T
    chosen = np.zeros(count, bool)
    chosen[members.maps[suspects]] = True
    if not chosen.any():
        chosen[int(np.argmax(np.bincount(members.maps)))] = True
    while chosen.sum() < most:
        more = np.where(chosen, 0.0, shared @ chosen.astype(np.float64))
        if not more.any():
            break
        chosen[int(np.argmax(more))] = True
    outside = np.bincount(members.tracks, weights=~chosen[members.maps], minlength=size)
    return np.asarray(outside == 0.0)


def spread_over(tracks: Ints, at_most: int, always: Ints) -> Ints:
    """Rows of some tracks, and of every n-th of the others, so that they are spread like all."""
    others = np.setdiff1d(tracks, always)
    left = max(at_most - int(np.isin(tracks, always).sum()), at_most // 4)
    every = max(1, -(-int(np.isin(tracks, others).sum()) // left))
    return np.flatnonzero(np.isin(tracks, np.union1d(others[::every], always)))
