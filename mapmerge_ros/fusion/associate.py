# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks of which sub-maps are the same physical point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from mapmerge_ros.arrays import Ints, Mask
from mapmerge_ros.association import number_by_id
from mapmerge_ros.submap import SubMap


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """Tracks: one per physical landmark, with at most one member in each sub-map."""

    tracks: tuple[Ints, ...]
    """Per sub-map the track (m_k,) of each compressed landmark"""
    count: int
    nameless: Mask
    """(count,) tracks whose landmark id has been given to another point as well"""
    catalogues: tuple[Ints, ...]
    """
    Per sub-map the track (n_k - m_k,) of each landmark of its catalogue; from `count` on where
    no sub-map has compressed that landmark
    """

    @property
    def views(self) -> Ints:
        """(count,) sub-maps in which each track has a member."""
        return np.bincount(np.concatenate(self.tracks), minlength=self.count)

    def shared_counts(self) -> scipy.sparse.csr_array:
        """(maps, maps) number of tracks common to two sub-maps, their own size on the diagonal."""
        lengths = [len(track) for track in self.tracks]
        rows = np.repeat(np.arange(len(self.tracks)), lengths)
        columns = np.concatenate([np.zeros(0, np.int64), *self.tracks])
        membership = scipy.sparse.csr_array(
            (np.ones(len(rows), np.int64), (rows, columns)), shape=(len(lengths), self.count)
        )
        return membership @ membership.T

    def restricted(self, maps: Sequence[int]) -> Association:
        """Return the tracks of some sub-maps only, renumbered without gaps."""
        return _numbered(
            [self.tracks[k] for k in maps], [self.catalogues[k] for k in maps], self.nameless
        )


def _numbered(tracks: Sequence[Ints], catalogues: Sequence[Ints], nameless: Mask) -> Association:
    """Tracks without gaps, those with a compressed landmark first."""
    used, inverse = np.unique(np.concatenate(tracks), return_inverse=True)
    others = np.concatenate(catalogues)
    rest = np.setdiff1d(others, used)
    known = np.isin(others, used)
    numbers = np.where(
        known, np.searchsorted(used, others), len(used) + np.searchsorted(rest, others)
    )
    return Association(
        tuple(np.split(inverse, _ends(tracks))),
        len(used),
        nameless[used],
        tuple(np.split(numbers, _ends(catalogues))),
    )


def _ends(parts: Sequence[Ints]) -> Ints:
    ends: Ints = np.cumsum([len(part) for part in parts])[:-1]
    return ends


def split_contradictions(
    association: Association, contradicting: Sequence[tuple[int, int, Ints]]
) -> Association:
    """
    Break up tracks that some pair of sub-maps (a, b) contradicts.

    Members of such a track that no pair sets apart stay together, in the order of the sub-maps.
    The largest group keeps the id if it has two members; what is left is merged without a name,
    and so does not leave the fusion.
    """
    apart: dict[int, set[tuple[int, int]]] = {}
    for a, b, tracks in contradicting:
        for track in tracks:
            apart.setdefault(int(track), set()).update({(a, b), (b, a)})
    if not apart:
        return association
    renumbered = [tracks.copy() for tracks in association.tracks]
    count, nameless = association.count, list[int]()
    for track, pairs in sorted(apart.items()):
        groups: list[list[int]] = []
        for k in (k for k, own in enumerate(association.tracks) if track in own):
            fits = [group for group in groups if not any((k, m) in pairs for m in group)]
            fits[0].append(k) if fits else groups.append([k])
        groups.sort(key=len, reverse=True)
        if len(groups[0]) < 2:
            nameless.append(track)
        for group in groups[1:]:
            for k in group:
                renumbered[k][association.tracks[k] == track] = count
            nameless.append(count)
            count += 1
    flags = np.zeros(count, bool)
    flags[: association.count] = association.nameless
    flags[nameless] = True
    added = count - association.count
    catalogues = [
        np.where(own >= association.count, own + added, own) for own in association.catalogues
    ]
    return Association(tuple(renumbered), count, flags, tuple(catalogues))


def associate_by_id(submaps: Sequence[SubMap]) -> Association:
    """Landmarks of equal id in the same non-empty id space are one track; all others are alone."""
    tracks, _ = number_by_id(submaps, [submap.landmark_ids for submap in submaps])
    return of_compressed(submaps, tracks)


def of_compressed(submaps: Sequence[SubMap], tracks: Sequence[Ints]) -> Association:
    """Association of sub-maps from tracks over all their landmarks, (n_k,) each."""
    if not submaps:
        return Association((), 0, np.zeros(0, bool), ())
    counts = [submap.compressed_count for submap in submaps]
    return _numbered(
        [own[:m] for own, m in zip(tracks, counts, strict=True)],
        [own[m:] for own, m in zip(tracks, counts, strict=True)],
        np.zeros(max(int(own.max()) for own in tracks) + 1, bool),
    )
