# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks of whole catalogues are one point: what can be asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Ids, Ints
from mapmerge_ros.submap import SubMap

ALONE = -1
"""Track of a landmark that is known to have no partner."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Tracks over all landmarks of each message, compressed or not."""

    tracks: tuple[Ints, ...]
    """
    Per sub-map (n_k,) the track of each landmark; an equal number is the same physical point.
    A landmark without a partner is ALONE, or has a number of its own.
    """
    count: int

    def without(self, submaps: Sequence[SubMap], denied: Sequence[Ids]) -> Tracks:
        """Leave out landmarks, named per sub-map."""
        return Tracks(
            tuple(
                np.where(np.isin(submap.landmark_ids, ids), ALONE, own)
                for submap, own, ids in zip(submaps, self.tracks, denied, strict=True)
            ),
            self.count,
        )
