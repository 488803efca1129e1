# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Ids of the landmarks that go out: those of a common id space, or names of our own."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Ids, Mask
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.submap import SubMap


@dataclass(frozen=True, slots=True, eq=False)
class Names:
    """What every landmark of some sub-maps is called in the map that they become."""

    ids: tuple[Ids, ...]
    """Per sub-map (n_k,); equal ids are one point"""
    id_space: str
    """That of the outgoing map"""
    nameless: Mask
    """(count,) tracks that cannot be named, because another one has their id"""

    def of_tracks(self, association: Association) -> Ids:
        """(count,) id of each track."""
        ids = np.zeros(association.count, np.uint64)
        for own, tracks in zip(self.ids, association.tracks, strict=True):
            ids[tracks] = own[: len(tracks)]
        return ids


def name_landmarks(submaps: Sequence[SubMap], association: Association) -> Names:
    """
    Name the landmarks of sub-maps that are merged into one.

    Within one id space, and for a map alone, ids stay what they are; of a landmark that moved,
    the newest place has the id. Otherwise a landmark is named after its first member, by order
    of the sub-maps: the name stays the same for as long as that member is there.
    """
    spaces = {submap.id_space for submap in submaps}
    if len(submaps) == 1 or (len(spaces) == 1 and '' not in spaces):
        own_ids = _current_first(submaps, association)
        nameless = association.nameless & _claimed_twice(submaps, association)
        return Names(own_ids, submaps[0].id_space, nameless)
    tracks = [
        np.concatenate([own, others])
        for own, others in zip(association.tracks, association.catalogues, strict=True)
    ]
    names = np.zeros(max(int(own.max()) for own in tracks) + 1, np.uint64)
    for submap, own in reversed(list(zip(submaps, tracks, strict=True))):
        names[own] = private_names(submap.map_id, submap.landmark_ids)
    nameless = np.zeros(association.count, bool)
    return Names(tuple(names[own] for own in tracks), '', nameless)


def _claimed_twice(submaps: Sequence[SubMap], association: Association) -> Mask:
    """Tracks (count,) whose id another track of these sub-maps has as well."""
    ids = np.zeros(association.count, np.uint64)
    for submap, tracks in zip(submaps, association.tracks, strict=True):
        ids[tracks] = submap.compressed_ids
    _, which, counts = np.unique(ids, return_inverse=True, return_counts=True)
    return np.asarray(counts[which] > 1)


def _current_first(submaps: Sequence[SubMap], association: Association) -> tuple[Ids, ...]:
    """Ids (n_k,) per sub-map; of several tracks with one id the newest keeps it."""
    own_ids = [submap.landmark_ids for submap in submaps]
    ids, newest = np.zeros(association.count, np.uint64), np.zeros(association.count, np.int64)
    for submap, tracks in zip(submaps, association.tracks, strict=True):
        ids[tracks] = submap.compressed_ids
        newest[tracks] = np.maximum(newest[tracks], submap.stamp_ns)
    order = np.lexsort((np.arange(association.count), -newest, association.nameless, ids))
    again = np.r_[False, ids[order][1:] == ids[order][:-1]]
    outdated = np.zeros(association.count, bool)
    outdated[order[again]] = True
    outdated &= ~association.nameless
    if not outdated.any():
        return tuple(own_ids)
    for submap, tracks in reversed(list(zip(submaps, association.tracks, strict=True))):
        old = outdated[tracks]
        ids[tracks[old]] = private_names(submap.map_id, submap.compressed_ids[old])
    return tuple(
        np.concatenate([ids[tracks], own[len(tracks) :]])
        for tracks, own in zip(association.tracks, own_ids, strict=True)
    )


def private_names(map_id: str, landmark_ids: Ids) -> Ids:
    """
    Names (n,) of landmarks outside their map, whose ids mean nothing there.

    64 bits that mix map and id: a collision among a million landmarks has odds 3e-8.
    """
    digest = hashlib.blake2b(map_id.encode(), digest_size=8).digest()
    value = landmark_ids ^ np.uint64(int.from_bytes(digest, 'little'))
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        value = (value ^ (value >> np.uint64(shift))) * np.uint64(factor)
    mixed: Ids = value ^ (value >> np.uint64(31))
    return mixed
