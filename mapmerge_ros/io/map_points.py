# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""All points of the merged map, catalogue included, and which sub-maps have them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion import Component, Fusion, MapAlignment
from mapmerge_ros.submap import SubMap

SEVERAL = -1
"""Owner of a point that more than one sub-map has."""

_Key = tuple[str, int]


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

    def __len__(self) -> int:
        return len(self.owners)


def map_points(fusion: Fusion) -> MapPoints:
    """Points of the published map; none where nothing could be merged."""
    if not fusion.components:
        return MapPoints((), np.zeros((0, 3)), np.zeros(0, int), np.zeros(0, int), 0)
    component = fusion.components[0]
    inside = [item for item in fusion.alignments if item.component == 0]
    slots = _slots(component, inside)
    count = max(int(own.max()) for own in slots) + 1
    everywhere = np.concatenate(slots)
    views = np.bincount(everywhere, minlength=count)
    owners = np.full(count, SEVERAL)
    for k, own in enumerate(slots):
        owners[own] = k
    owners[views > 1] = SEVERAL
    return MapPoints(
        map_ids=tuple(item.submap.map_id for item in inside),
        points_global=_positions(component, inside, everywhere, views),
        owners=owners,
        views=views,
        landmark_count=len(component.landmarks.ids),
    )


def _slots(component: Component, inside: list[MapAlignment]) -> list[Ints]:
    """Per sub-map the point (n_k,) that each of its landmarks is."""
    submaps = {item.submap.map_id: item.submap for item in inside}
    landmarks = component.landmarks
    known: dict[_Key, int] = {}
    members = zip(
        landmarks.member_maps,
        landmarks.member_ids.tolist(),
        landmarks.member_rows.tolist(),
        strict=True,
    )
    rows: dict[str, dict[int, int]] = {map_id: {} for map_id in submaps}
    for map_id, landmark_id, row in members:
        rows[map_id][landmark_id] = row
        known.setdefault(_key(submaps[map_id], landmark_id), row)
    count = len(landmarks.ids)
    slots = []
    for item in inside:
        own = np.zeros(len(item.submap.landmark_ids), np.int64)
        for k, landmark_id in enumerate(item.submap.landmark_ids.tolist()):
            row = rows[item.submap.map_id].get(landmark_id)
            if row is None:
                row = known.setdefault(_key(item.submap, landmark_id), count)
                count += row == count
            own[k] = row
        slots.append(own)
    return slots


def _key(submap: SubMap, landmark_id: int) -> _Key:
    """What makes a landmark the same in two sub-maps: a private id is that of one map only."""
    return (f'space {submap.id_space}' if submap.id_space else f'map {submap.map_id}', landmark_id)


def _positions(
    component: Component, inside: list[MapAlignment], everywhere: Ints, views: Ints
) -> Floats:
    placed = [item.S_global_map.apply(item.submap.points) for item in inside]
    totals = np.zeros((len(views), 3))
    np.add.at(totals, everywhere, np.concatenate(placed))
    points: Floats = totals / np.maximum(views, 1)[:, None]
    points[: len(component.landmarks.ids)] = component.landmarks.points_global
    return points
