# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How large the message of a sub-map is, and how many landmarks fit into a given size."""

from __future__ import annotations

import math
from collections.abc import Iterable

from mapmerge_ros.submap.submap import Source, SubMap

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
    if catalogue:
        most = most_within(max_bytes - catalogue_bytes(submap))
    else:
        most = most_within(max_bytes - _head_bytes(submap), _landmark_bytes(submap))
    return min(most, len(submap.landmark_ids))


def most_within(room_bytes: int, each_bytes: int = 0) -> int:
    """How many landmarks have R, c and `each_bytes` more of their own in `room_bytes`."""
    # information_bytes is 18 m² + 18 m.
    linear = 18 + each_bytes
    return (math.isqrt(linear**2 + 72 * max(room_bytes, 0)) - linear) // 36


def head_bytes(names: Iterable[str], leaves: Iterable[Source]) -> int:
    """Upper bound of all that does not grow with the landmarks [byte]."""
    texts = sum(len(name.encode()) for name in names)
    return FIXED_BYTES + texts + sum(len(x.map_id.encode()) + SOURCE_BYTES for x in leaves)


def landmark_bytes(has_covariances: bool, descriptor_size: int) -> int:
    """Id, position, covariance and descriptor of one landmark [byte]."""
    return 8 + 24 + (24 if has_covariances else 0) + descriptor_size


def _head_bytes(submap: SubMap) -> int:
    names = (submap.map_id, submap.robot_id, submap.frame_id, submap.id_space)
    return head_bytes(names, submap.sources)


def _landmark_bytes(submap: SubMap) -> int:
    return landmark_bytes(submap.covariances is not None, submap.descriptors.size)
