# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""All points of the merged map, catalogue included, and which sub-maps have them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion import Component, Fusion, MapAlignment

SEVERAL = -1
"""Owner of a point that more than one sub-map has."""


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """Points of a component: first its merged landmarks, in their order, then its catalogue."""

    map_ids: tuple[str, ...]
    points_global: Floats
    """(n, 3)"""
    owners: Ints
    """(n,) index into `map_ids`, or SEVERAL"""
    views: Ints
    """(n,) sub-maps that have the point"""
    landmark_count: int
    rows: tuple[Ints, ...]
    """Per sub-map of `map_ids`, the point (n_k,) that each of its landmarks is"""

    def __len__(self) -> int:
        return len(self.owners)


def map_points(fusion: Fusion) -> MapPoints:
    """Points of the published map; none where nothing could be merged."""
    if not fusion.components:
        return MapPoints((), np.zeros((0, 3)), np.zeros(0, int), np.zeros(0, int), 0, ())
    component = fusion.components[0]
    alignments = {item.submap.map_id: item for item in fusion.alignments}
    inside = [alignments[map_id] for map_id in component.map_ids]
    slots = _slots(component)
    count = max(int(own.max()) for own in slots) + 1
    everywhere = np.concatenate(slots)
    views = np.bincount(everywhere, minlength=count)
    owners = np.full(count, SEVERAL)
    for k, own in enumerate(slots):
        owners[own] = k
    owners[views > 1] = SEVERAL
    return MapPoints(
        map_ids=component.map_ids,
        points_global=_positions(component, inside, everywhere, views),
        owners=owners,
        views=views,
        landmark_count=len(component.landmarks.ids),
        rows=tuple(slots),
    )


def _slots(component: Component) -> list[Ints]:
    """Per sub-map the point (n_k,) that each of its landmarks is: merged landmarks come first."""
    association = component.association
    tracks = [
        np.concatenate([own, others])
        for own, others in zip(association.tracks, association.catalogues, strict=True)
    ]
    used = np.unique(np.concatenate(tracks))
    is_landmark = used < association.count
    is_landmark[is_landmark] = ~component.names.nameless[used[is_landmark]]
    places = np.argsort(np.argsort(~is_landmark, kind='stable'))
    return [places[np.searchsorted(used, own)] for own in tracks]


def _positions(
    component: Component, inside: list[MapAlignment], everywhere: Ints, views: Ints
) -> Floats:
    placed = [item.S_global_map.apply(item.submap.points) for item in inside]
    totals = np.zeros((len(views), 3))
    np.add.at(totals, everywhere, np.concatenate(placed))
    points: Floats = totals / np.maximum(views, 1)[:, None]
    points[: len(component.landmarks.ids)] = component.landmarks.points_global
    return points
