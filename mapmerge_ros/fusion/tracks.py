# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The catalogue that goes on with the merged landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Bytes, Floats, Ids, Ints, Mask
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.names import Names
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import (
    Descriptors,
    DescriptorType,
    SubMap,
    symmetric_from_upper,
    upper_from_symmetric,
)


@dataclass(frozen=True, slots=True, eq=False)
class Catalogue:
    """All landmarks of a component by id: where they are, how sure, what they look like."""

    ids: Ids
    """(n,) ascending"""
    points_global: Floats
    """(n, 3) as merged, else the mean over the sub-maps that have the landmark"""
    covariances: Floats | None
    """(n, 6) triangulation covariance, members combined; None where one does not know"""
    descriptors: Descriptors
    """of the first sub-map that has the landmark"""

    def rows(self, ids: Ids) -> Ints:
        """Rows of ids that are in the catalogue."""
        return np.searchsorted(self.ids, ids)

    def solved(self, ids: Ids, points_global: Floats) -> Catalogue:
        """Return the same with some of the landmarks (m,) where the merge has them (m, 3)."""
        points = self.points_global.copy()
        points[self.rows(ids)] = points_global
        return replace(self, points_global=points)


def build_catalogue(
    submaps: Sequence[SubMap],
    S_global_maps: Sequence[Similarity],
    association: Association,
    names: Names,
) -> Catalogue:
    """Collect every landmark of the sub-maps that has a name, in the global frame."""
    named = [
        _named(submap, ids, names.nameless[tracks])
        for submap, ids, tracks in zip(submaps, names.ids, association.tracks, strict=True)
    ]
    members = np.concatenate([part.landmark_ids for part in named])
    ids, first, slots = np.unique(members, return_index=True, return_inverse=True)
    slots = slots.ravel()
    placed = [
        S_global_map.apply(part.points)
        for part, S_global_map in zip(named, S_global_maps, strict=True)
    ]
    totals = np.zeros((len(ids), 3))
    np.add.at(totals, slots, np.concatenate(placed))
    points = totals / np.bincount(slots)[:, None]
    covariances = _combined(named, S_global_maps, slots, len(ids))
    return Catalogue(ids, points, covariances, _descriptors(named, first))


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """The part of a sub-map that a catalogue is about."""

    landmark_ids: Ids
    points: Floats
    covariances: Floats | None
    descriptors: Descriptors


def _named(submap: SubMap, ids: Ids, nameless: Mask) -> _Points:
    keep = np.ones(len(submap.landmark_ids), bool)
    keep[: submap.compressed_count] = ~nameless
    covariances = None if submap.covariances is None else submap.covariances[keep]
    return _Points(ids[keep], submap.points[keep], covariances, submap.descriptors[keep])


def _combined(
    submaps: Sequence[_Points], S_global_maps: Sequence[Similarity], slots: Ints, count: int
) -> Floats | None:
    """Inverse of the summed informations (n, 6): members see a landmark independently."""
    informations = []
    for submap, S_global_map in zip(submaps, S_global_maps, strict=True):
        if submap.covariances is None:
            return None
        linear = S_global_map.scale * S_global_map.rotation
        turned = linear @ symmetric_from_upper(submap.covariances) @ linear.T
        informations.append(np.linalg.pinv(turned, hermitian=True))
    total = np.zeros((count, 3, 3))
    np.add.at(total, slots, np.concatenate(informations))
    combined: Floats = np.linalg.pinv(total, hermitian=True)
    return upper_from_symmetric(combined)


def _descriptors(submaps: Sequence[_Points], first: Ints) -> Descriptors:
    """Descriptors of some of the concatenated landmarks; none where the kinds differ."""
    kinds = {(submap.descriptors.type, submap.descriptors.size) for submap in submaps}
    if len(kinds) != 1 or DescriptorType.NONE in {kind for kind, _ in kinds}:
        return Descriptors.none(len(first))
    rows: Bytes = np.concatenate([submap.descriptors.rows for submap in submaps])
    return Descriptors(submaps[0].descriptors.type, rows[first])
