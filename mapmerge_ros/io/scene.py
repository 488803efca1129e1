# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The sub-maps of a fusion in space: each by itself as it was sent, and in the merged map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.fusion import Fusion, MapAlignment
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io.map_points import MapPoints, map_points
from mapmerge_ros.io.viewpoint import Viewpoint, viewpoint

MAX_POINTS = 60_000
"""Drawn points: 1.1 MB of report; a phone turns them in 20 ms."""

MAX_RADII = 4.0
"""Distance from the middle, in radii of a map, from which a point is a stray and not drawn."""

HALF_WIDTH, HALF_HEIGHT = 1.0, 0.65
"""Of the sub-maps side by side: what a screen shows of the floor of a map of radius 1."""

FILLED, GAP = 0.38, 0.3
"""Radius of a sub-map in its cell; between the map and those apart from it, below."""

MIN_COLUMNS, MAX_COLUMNS = 5, 14
"""Of the sub-maps that are apart."""

NOWHERE = -1


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Points of sub-maps in the frame of a viewpoint, twice."""

    alignments: tuple[MapAlignment, ...]
    """Of the sub-maps that have points"""
    viewpoint: Viewpoint
    sent: Floats
    """(n, 3) every sub-map in its own frame and scale, side by side"""
    merged: Floats
    """(n, 3) in the merged map; sub-maps that are not in it side by side below"""
    owners: Ints
    """(n,) index into `alignments`"""
    slots: Ints
    """(n,) point of the merged map, or NOWHERE where the sub-map is not in it"""
    is_shared: Mask
    """(n,) whether other sub-maps have the point too"""
    is_landmark: Mask
    """(n,) whether it is a merged landmark"""
    total: int
    """Points before strays and what is too much for a screen were left out"""

    def same_points(self, most: int) -> Ints:
        """Rows (m, 2) of points that are one in the merged map, at most so many of them."""
        order = np.argsort(self.slots, kind='stable')
        slots = self.slots[order]
        same = np.flatnonzero((slots[1:] == slots[:-1]) & (slots[1:] != NOWHERE))
        if len(same) > most:
            same = same[np.linspace(0, len(same) - 1, most).astype(int)]
        return np.stack([order[same], order[same + 1]], axis=1)


def make_scene(fusion: Fusion, max_points: int = MAX_POINTS) -> Scene:
    """All points that a screen can show; merged landmarks before others."""
    points = map_points(fusion)
    gauge = fusion.components[0].gauge if fusion.components else Gauge.SIMILARITY
    view = viewpoint(points.points_global, gauge)
    shown = tuple(item for item in fusion.alignments if len(item.submap.points))
    slots = dict(zip(points.map_ids, points.rows, strict=True))
    apart = [item for item in shown if item.submap.map_id not in slots]
    below = _below(len(apart))
    parts = list[_Part]()
    for item, (x, y, size) in zip(shown, _side_by_side(len(shown)), strict=True):
        own = _in_own_frame(item)
        sent = size * own + np.array([x, y, 0.0])
        rows = slots.get(item.submap.map_id)
        if rows is None:
            x, y, size = below[apart.index(item)]
            merged, rows = size * own + np.array([x, y, 0.0]), np.full(len(own), NOWHERE)
        else:
            merged = view.points(points.points_global[rows])
        parts.append((sent, merged, own, rows))
    return _chosen(shown, view, points, parts, max_points)


_Part = tuple[Floats, Floats, Floats, Ints]
"""Of one sub-map: its points as sent, merged, in its own frame; which points of the map."""


def _in_own_frame(item: MapAlignment) -> Floats:
    """Points (n, 3) of a sub-map about its middle, its radius the unit, its axes as sent."""
    points = item.submap.points
    own = viewpoint(points, Gauge.NONE)
    return own.points(points)


def _side_by_side(count: int) -> list[tuple[float, float, float]]:
    """Middle x, y and size of every sub-map, in reading order."""
    rows = max(1, round(np.sqrt(count * HALF_HEIGHT / HALF_WIDTH)))
    columns = max(1, -(-count // rows))
    cell = 2.0 * min(HALF_WIDTH / columns, HALF_HEIGHT / rows)
    height = cell * rows
    return [
        (
            (k % columns + 0.5 - 0.5 * columns) * cell,
            0.5 * height - (k // columns + 0.5) * cell,
            FILLED * cell,
        )
        for k in range(count)
    ]


def _below(count: int) -> list[tuple[float, float, float]]:
    """Middle x, y and size of every sub-map that is apart from the merged ones."""
    columns = max(MIN_COLUMNS, min(count, MAX_COLUMNS))
    cell = 2.0 * HALF_WIDTH / columns
    wide = min(count, columns)
    return [
        (
            (k % columns + 0.5 - 0.5 * wide) * cell,
            -1.0 - GAP - (k // columns) * cell,
            FILLED * cell,
        )
        for k in range(count)
    ]


def _chosen(
    shown: tuple[MapAlignment, ...],
    view: Viewpoint,
    points: MapPoints,
    parts: list[_Part],
    max_points: int,
) -> Scene:
    counts = [len(part[0]) for part in parts]
    empty = (*np.zeros((3, 0, 3)), np.zeros(0, int))
    sent, merged, own, slots = (
        np.concatenate(arrays) for arrays in zip(empty, *parts, strict=True)
    )
    is_landmark = (slots != NOWHERE) & (slots < points.landmark_count)
    is_stray = np.maximum(np.abs(own), np.abs(merged)).max(axis=1) >= MAX_RADII
    first = np.flatnonzero(is_landmark & ~is_stray)[:max_points]
    others = np.flatnonzero(~is_landmark & ~is_stray)
    room = min(len(others), max_points - len(first))
    spread = others[np.linspace(0, len(others) - 1, room).astype(int)] if room else others[:0]
    rows = np.sort(np.concatenate([first, spread]))
    views = np.append(points.views, 0)  # the last is that of a point that is nowhere
    return Scene(
        alignments=shown,
        viewpoint=view,
        sent=sent[rows],
        merged=merged[rows],
        owners=np.repeat(np.arange(len(shown)), counts)[rows],
        slots=slots[rows],
        is_shared=views[slots[rows]] > 1,
        is_landmark=is_landmark[rows],
        total=sum(counts),
    )
