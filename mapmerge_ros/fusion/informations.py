# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How well each landmark of each sub-map is determined: for aligning the sub-maps."""

from __future__ import annotations

from collections.abc import Sequence

from mapmerge_ros.fusion.joint.root import Unpacked
from mapmerge_ros.submap import LandmarkInformation, SubMap


def informations(submaps: Sequence[SubMap]) -> tuple[LandmarkInformation, ...]:
    """`LandmarkInformation` of the compressed landmarks of each sub-map."""
    if not submaps:
        return ()
    unpacked = Unpacked(3 * max(submap.compressed_count for submap in submaps))
    return tuple(
        LandmarkInformation.of(
            unpacked.trapezoid(submap.packed_r, submap.rank, 3 * submap.compressed_count)
        )
        for submap in submaps
    )
