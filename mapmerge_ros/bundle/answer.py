# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot's answer to a request: its bundle, compressed to what it was asked for."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Ids
from mapmerge_ros.bundle.bundle import Bundle
from mapmerge_ros.bundle.compress import MapName, compress
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.submap import Request, SubMap, most_landmarks


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What a robot makes of a request."""

    submap: SubMap | None
    """The next revision; None when there is none"""
    reason: str
    """Why not; empty with a sub-map"""
    unknown: Ids
    """Requested ids that the bundle does not have"""
    dropped: int
    """Landmarks left out from the end, to keep the size"""


def answer(bundle: Bundle, announced: SubMap, request: Request, revision: int) -> Answer:
    """
    Compress a bundle to the requested landmarks, as the given revision of its announced map.

    Ids that the bundle does not have are left out; landmarks are dropped from the end until the
    message keeps `request.max_bytes`.
    """
    known = np.isin(request.landmark_ids, bundle.point_ids)
    ids, unknown = request.landmark_ids[known], request.landmark_ids[~known]
    room = most_landmarks(announced, request.max_bytes) if request.max_bytes else len(ids)
    kept = ids[:room]
    left_out = unknown, len(ids) - len(kept)
    if 3 * len(kept) <= int(bundle.gauge):
        reason = f'{len(kept)} landmarks are left, too few for gauge {int(bundle.gauge)}'
        return Answer(None, reason, *left_out)
    try:
        found = compress(bundle, _renamed(announced, revision), kept)
    except DegenerateGeometry as err:
        return Answer(None, str(err), *left_out)
    return Answer(found, '', *left_out)


def announce(bundle: Bundle, name: MapName) -> SubMap:
    """All landmarks of a bundle, none of them compressed: position, covariance, descriptor."""
    return compress(bundle, name, np.zeros(0, np.uint64))


def _renamed(submap: SubMap, revision: int) -> MapName:
    return MapName(
        submap.map_id,
        submap.robot_id,
        revision,
        submap.stamp_ns,
        submap.frame_id,
        submap.id_space,
    )


def reannounce(announced: SubMap, revision: int) -> SubMap:
    """Return the same announcement under a later revision."""
    sources = tuple(replace(source, revision=revision) for source in announced.sources)
    return replace(announced, revision=revision, sources=sources)
