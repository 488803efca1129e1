# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of the size that 100 landmarks make, 184 kB: what throughput is measured with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mapmerge_ros.geometry import Gauge
from mapmerge_ros.submap import Descriptors, Source, SubMap, packed_size

LANDMARKS = 100


def submap(drone: int, revision: int, landmarks: int = LANDMARKS) -> SubMap:
    """A sub-map that passes every check; its R is noise, as real ones are to a compressor."""
    rng = np.random.default_rng([drone, revision])
    rank = 3 * landmarks - int(Gauge.SIMILARITY)
    map_id = f'drone{drone}/0001'
    return SubMap(
        map_id=map_id,
        robot_id=f'drone{drone}',
        revision=revision,
        stamp_ns=revision,
        frame_id=map_id,
        sources=(Source(map_id, revision),),
        gauge=Gauge.SIMILARITY,
        id_space='fleet',
        landmark_ids=np.arange(landmarks, dtype=np.uint64),
        points=rng.normal(size=(landmarks, 3)),
        covariances=None,
        compressed_count=landmarks,
        a=70.0,
        packed_r=rng.normal(size=packed_size(rank, 3 * landmarks)).astype(np.float32),
        c=np.zeros(rank),
        residual_count=10_000,
        dof=3_000,
        sigma=0.5,
        descriptors=Descriptors.none(landmarks),
    )


def next_revision(known: SubMap) -> SubMap:
    """The same knowledge under the next revision."""
    revision = known.revision + 1
    return replace(
        known,
        revision=revision,
        stamp_ns=revision,
        sources=(Source(known.map_id, revision),),
    )
