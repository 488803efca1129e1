# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How large the message of a sub-map is, and how many landmarks fit into a given size."""

from __future__ import annotations

import math

from mapmerge_ros.submap.submap import SubMap

FIXED_BYTES = 512
"""Numbers, lengths and alignment of all fields that do not grow."""
SOURCE_BYTES = 16
"""Of one leaf beside its name."""


def catalogue_bytes(submap: SubMap) -> int:
    """Upper bound of the message without R and c [byte]."""
    return _head_bytes(submap) + _landmark_bytes(submap) * len(submap.landmark_ids)


def information_bytes(count: int) -> int:
    """Upper bound of R and c of `count` landmarks, float32, whatever the gauge [byte]."""
    return 4 * (3 * count * (3 * count + 1) // 2 + 3 * count)


def most_landmarks(submap: SubMap, max_bytes: int, *, catalogue: bool = True) -> int:
    """
    How many landmarks may be compressed so that the message keeps `max_bytes`.

    `catalogue` says whether the others go along, as in `compress`.
    """
    # information_bytes is 18 m² + 18 m; without a catalogue each landmark brings its own bytes.
    fixed = catalogue_bytes(submap) if catalogue else _head_bytes(submap)
    linear = 18 if catalogue else 18 + _landmark_bytes(submap)
    room = max(max_bytes - fixed, 0)
    most = (math.isqrt(linear**2 + 72 * room) - linear) // 36
    return min(most, len(submap.landmark_ids))


def _head_bytes(submap: SubMap) -> int:
    names = (submap.map_id, submap.robot_id, submap.frame_id, submap.id_space)
    texts = sum(len(name.encode()) for name in names)
    leaves = sum(len(source.map_id.encode()) + SOURCE_BYTES for source in submap.sources)
    return FIXED_BYTES + texts + leaves


def _landmark_bytes(submap: SubMap) -> int:
    """Id, position, covariance and descriptor of one landmark."""
    return 8 + 24 + (0 if submap.covariances is None else 24) + submap.descriptors.size
