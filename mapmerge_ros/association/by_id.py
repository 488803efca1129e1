# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks that are the same because their ids say so."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapmerge_ros.arrays import Ids, Ints
from mapmerge_ros.submap import SubMap


def number_by_id(submaps: Sequence[SubMap], ids: Sequence[Ids]) -> tuple[tuple[Ints, ...], int]:
    """
    Track number of each of the given ids of each sub-map, and how many numbers there are.

    The numbering follows (id space, id), then the order of the sub-maps.
    """
    spaces = sorted({submap.id_space for submap in submaps if submap.id_space})
    tracks: list[Ints] = [np.zeros(0, np.int64) for _ in submaps]
    count = 0
    for space in spaces:
        members = [k for k, submap in enumerate(submaps) if submap.id_space == space]
        unique, inverse = np.unique(np.concatenate([ids[k] for k in members]), return_inverse=True)
        ends = np.cumsum([len(ids[k]) for k in members])[:-1]
        for k, part in zip(members, np.split(inverse.ravel(), ends), strict=True):
            tracks[k] = count + part.astype(np.int64)
        count += len(unique)
    for k, submap in enumerate(submaps):
        if not submap.id_space:
            tracks[k] = count + np.arange(len(ids[k]))
            count += len(ids[k])
    return tuple(tracks), count
