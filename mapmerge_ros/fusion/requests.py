# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What to ask the robots for: only where it would change something that matters."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from mapmerge_ros.arrays import Ids, Ints, Mask
from mapmerge_ros.fusion.catalogues import Tracks
from mapmerge_ros.fusion.choice import choose_landmarks
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.submap import Request, SubMap, most_landmarks


@dataclass(frozen=True, slots=True, eq=False)
class Denial:
    """What one robot was asked for and did not do, for its map."""

    landmark_ids: Ids
    """Left out of the answer"""
    capacity: int
    """Landmarks in the answer: it has not shown that it can do more"""


def plan_requests(
    submaps: Sequence[SubMap],
    tracks: Tracks,
    config: FusionConfig,
    denied: Mapping[str, Denial] | None = None,
) -> tuple[Request, ...]:
    """
    Requests that bring every pair of sub-maps to what it should have in common, by map_id.

    `tracks` is about all landmarks of these sub-maps. `denied` says, per map_id, what a robot
    was asked for and did not compress: nobody is asked for that again. A sub-map whose compressed
    landmarks already serve each of its pairs to `config.request_coverage` is left alone.
    """
    denied = denied or {}
    if len(submaps) < 2:
        return ()
    limits = [denied.get(submap.map_id, _NO_DENIAL) for submap in submaps]
    tracks = tracks.without(submaps, [limit.landmark_ids for limit in limits])
    if _has_all(submaps, tracks):
        return ()
    budgets = [
        min(landmark_budget(submap, config), limit.capacity)
        for submap, limit in zip(submaps, limits, strict=True)
    ]
    wanted = choose_landmarks(submaps, tracks, budgets, config.min_shared)
    asked = _lacking(submaps, tracks, wanted, config)
    requests = [
        Request(
            submap.map_id,
            submap.robot_id,
            submap.revision,
            ids,
            config.request_bytes,
            submap.frame_id,
        )
        for submap, ids, is_asked in zip(submaps, wanted, asked, strict=True)
        if is_asked and 3 * len(ids) > int(submap.gauge)
    ]
    return tuple(sorted(requests, key=lambda request: request.map_id))


_NO_DENIAL = Denial(np.zeros(0, np.uint64), sys.maxsize)


def landmark_budget(submap: SubMap, config: FusionConfig) -> int:
    """Most landmarks that may be asked of a sub-map."""
    if not config.request_bytes:
        return config.request_landmarks
    return min(config.request_landmarks, most_landmarks(submap, config.request_bytes))


def _has_all(submaps: Sequence[SubMap], tracks: Tracks) -> bool:
    """Whether all that any two sub-maps have in common is compressed: then no choice is better."""
    members = _membership([own[own >= 0] for own in tracks.tracks], tracks.count)
    owners = np.asarray(members.sum(axis=0))
    return not any(
        (owners[listed[listed >= 0]] > 1).any()
        for submap, own in zip(submaps, tracks.tracks, strict=True)
        if len(listed := own[submap.compressed_count :])
    )


def _lacking(
    submaps: Sequence[SubMap], tracks: Tracks, wanted: Sequence[Ids], config: FusionConfig
) -> Mask:
    """
    Which sub-maps (maps,) have to be asked so that no pair falls short.

    One that is asked drops what it had, which may leave a partner short that was well served
    before: so the answer is the fixed point.
    """
    wants = _membership(
        [
            own[np.isin(submap.landmark_ids, ids) & (own >= 0)]
            for submap, own, ids in zip(submaps, tracks.tracks, wanted, strict=True)
        ],
        tracks.count,
    )
    has = _membership(
        [
            own[: submap.compressed_count][own[: submap.compressed_count] >= 0]
            for submap, own in zip(submaps, tracks.tracks, strict=True)
        ],
        tracks.count,
    )
    goal = scipy.sparse.triu(wants @ wants.T, 1).tocoo()
    counts = goal.data >= config.min_shared
    a, b = goal.row[counts], goal.col[counts]
    enough = config.request_coverage * goal.data[counts]
    asked = np.zeros(len(submaps), bool)
    if not len(a):
        return asked
    known = (has.multiply(wants)).tocsr() @ wants.T
    lacks_a, lacks_b = known[a, b] < enough, known[b, a] < enough
    while True:
        after = (wants.multiply(asked[:, None]) + has.multiply(~asked[:, None])).tocsr()
        short = (after @ after.T)[a, b] < enough
        # Each may have enough of its own, and yet too little of it be the same.
        grown = asked.copy()
        grown[a[short & (lacks_a | ~lacks_b)]] = True
        grown[b[short & (lacks_b | ~lacks_a)]] = True
        if (grown == asked).all():
            return asked
        asked = grown


def _membership(tracks: Sequence[Ints], count: int) -> scipy.sparse.csr_array:
    """(maps, tracks) 1 where a sub-map has a member."""
    lengths = [len(own) for own in tracks]
    rows = np.repeat(np.arange(len(tracks)), lengths)
    columns = np.concatenate([np.zeros(0, np.int64), *tracks])
    members = scipy.sparse.csr_array(
        (np.ones(len(rows), np.int64), (rows, columns)), shape=(len(tracks), count)
    )
    members.data[:] = 1  # the constructor adds up what comes twice
    return members
