# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Single landmarks that are off: doubtful, since one cannot be told from a bad track."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.arrays import Ints
from mapmerge_ros.fusion.local import LocalTests

FALSE_DISCOVERIES = 0.02
"""
Share of those reported that may be there by chance, on average.

At 0.01 one in twenty of what moved by six standard deviations among 30 landmarks is missed.
"""


def doubtful_members(tests: LocalTests, objects: Ints) -> Ints:
    """
    Members below the level of Benjamini and Hochberg, ascending, one of a track.

    `objects` are members that have been explained. Of a landmark of two sub-maps either may be
    the one that is off.
    """
    tested = np.setdiff1d(np.flatnonzero(tests.distinct), objects)
    p_values = tests.p_value[tested]
    order = np.argsort(p_values, kind='stable')
    levels = FALSE_DISCOVERIES * np.arange(1, len(order) + 1) / max(len(order), 1)
    below = np.flatnonzero(p_values[order] <= levels)
    chosen = tested[order[: below[-1] + 1]] if len(below) else tested[:0]
    _, first = np.unique(tests.members.tracks[chosen], return_index=True)  # the most significant
    return np.sort(chosen[first])
