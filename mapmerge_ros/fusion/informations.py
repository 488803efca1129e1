# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How well each landmark of each sub-map is determined: weights for aligning the sub-maps."""

from __future__ import annotations

from collections.abc import Sequence

from mapmerge_ros.arrays import Floats
from mapmerge_ros.fusion.joint.root import Unpacked
from mapmerge_ros.submap import SubMap, alignment_weights


def informations(submaps: Sequence[SubMap]) -> tuple[Floats, ...]:
    """`alignment_weights` (m_k,) of each sub-map."""
    if not submaps:
        return ()
    unpacked = Unpacked(3 * max(submap.compressed_count for submap in submaps))
    return tuple(
        alignment_weights(
            unpacked.trapezoid(submap.packed_r, submap.rank, 3 * submap.compressed_count)
        )
        for submap in submaps
    )
