# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""First landmarks for the joint merge: frames along the map graph, then all frames at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mapmerge_ros.arrays import Floats
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.element import Element
from mapmerge_ros.geometry import Gauge, Similarity, align

SWEEPS = 5
"""Generalised Procrustes converges linearly; the merge needs its basin, not its optimum."""


def initial_points(
    elements: Sequence[Element], S_centre_maps: Mapping[int, Similarity], centre: int, count: int
) -> Floats:
    """
    Landmarks (count, 3) in the frame of the central element.

    `S_centre_maps` holds the frame of every element, by index. Frames are re-estimated against
    the mean of all (generalised Procrustes), each in the group of its own gauge, and the mean
    is put back into the frame of the centre, so that scale cannot shrink away.
    """
    frames = [S_centre_maps[k] for k in range(len(elements))]
    points = _mean(elements, frames, count)
    for _ in range(SWEEPS):
        try:
            frames = [_onto(element, points) for element in elements]
        except DegenerateGeometry:
            return points
        if elements[centre].gauge is not Gauge.NONE:
            S_centre_mean = frames[centre].inverse()
            frames = [S_centre_mean @ S_mean_map for S_mean_map in frames]
        points = _mean(elements, frames, count)
    return points


def _onto(element: Element, points: Floats) -> Similarity:
    return align(
        points[element.tracks], element.points_map, gauge=element.gauge, weights=element.weights
    ).S_target_source


def _mean(elements: Sequence[Element], frames: Sequence[Similarity], count: int) -> Floats:
    """Weighted mean of all members; weights are informations, so they scale with the frame."""
    total, weight = np.zeros((count, 3)), np.zeros(count)
    for element, S_mean_map in zip(elements, frames, strict=True):
        own = (element.weights + np.finfo(float).tiny) / S_mean_map.scale**2
        total[element.tracks] += own[:, None] * S_mean_map.apply(element.points_map)
        weight[element.tracks] += own
    return total / weight[:, None]
