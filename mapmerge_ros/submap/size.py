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
    per_landmark = 8 + 24 + (0 if submap.covariances is None else 24) + submap.descriptors.size
    names = (submap.map_id, submap.robot_id, submap.frame_id, submap.id_space)
    texts = sum(len(name.encode()) for name in names)
    leaves = sum(len(source.map_id.encode()) + SOURCE_BYTES for source in submap.sources)
    return FIXED_BYTES + texts + leaves + per_landmark * len(submap.landmark_ids)


def information_bytes(count: int) -> int:
    """Upper bound of R and c of `count` landmarks, float32, whatever the gauge [byte]."""
    return 4 * (3 * count * (3 * count + 1) // 2 + 3 * count)


def most_landmarks(submap: SubMap, max_bytes: int) -> int:
    """How many landmarks may be compressed so that the message keeps `max_bytes`."""
    # information_bytes is 18 m² + 18 m.
    room = max(max_bytes - catalogue_bytes(submap), 0)
    return (math.isqrt(1 + 4 * room // 18) - 1) // 2
