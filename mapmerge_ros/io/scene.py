# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The sub-maps of a fusion in space: each by itself as it was sent, and in the merged map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.fusion import Fusion, MapAlignment
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io.map_points import map_points
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
    is_shared: Mask
    """(n,) whether other sub-maps have the point too"""
    is_landmark: Mask
    """(n,) whether it is a merged landmark"""
    total: int
    """Points before strays and what is too much for a screen were left out"""


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
            merged = size * own + np.array([x, y, 0.0])
            parts.append((sent, merged, own, *np.zeros((2, len(own)), bool)))
        else:
            merged = view.points(points.points_global[rows])
            is_shared, is_landmark = points.views[rows] > 1, rows < points.landmark_count
            parts.append((sent, merged, own, is_shared, is_landmark))
    return _chosen(shown, view, parts, max_points)


_Part = tuple[Floats, Floats, Floats, Mask, Mask]
"""Of one sub-map: sent, merged, in its own frame, shared, landmark."""


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
    shown: tuple[MapAlignment, ...], view: Viewpoint, parts: list[_Part], max_points: int
) -> Scene:
    counts = [len(part[0]) for part in parts]
    empty = (np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), *np.zeros((2, 0), bool))
    sent, merged, own, is_shared, is_landmark = (
        np.concatenate(arrays) for arrays in zip(empty, *parts, strict=True)
    )
    limits = np.abs(own).max(axis=1) < MAX_RADII, np.abs(merged).max(axis=1) < MAX_RADII
    near = np.flatnonzero(limits[0] & limits[1])
    first = near[is_landmark[near]][:max_points]
    others = near[~is_landmark[near]]
    room = min(len(others), max_points - len(first))
    spread = others[np.linspace(0, len(others) - 1, room).astype(int)] if room else others[:0]
    rows = np.sort(np.concatenate([first, spread]))
    return Scene(
        alignments=shown,
        viewpoint=view,
        sent=sent[rows],
        merged=merged[rows],
        owners=np.repeat(np.arange(len(shown)), counts)[rows],
        is_shared=is_shared[rows],
        is_landmark=is_landmark[rows],
        total=sum(counts),
    )
