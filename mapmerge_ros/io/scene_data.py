# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The scene as the page of a report takes it in: plain values and packed numbers."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.fusion import Fusion
from mapmerge_ros.io.drawing_graph import common_landmarks
from mapmerge_ros.io.palette import Rgb
from mapmerge_ros.io.scene import Scene

MAX_LINKS = 400
"""Lines between sub-maps; those with most in common."""

SHARED_BIT, LANDMARK_BIT = 1 << 15, 1 << 14
"""Of the number that says whose a point is; the rest of it is the sub-map."""

STEPS = 65535
"""Of a coordinate in 16 bits: a ten-thousandth of the radius of the map."""

SQUARES = 8
"""Of the floor, about, from side to side."""


def scene_data(
    scene: Scene, fusion: Fusion, palette: Mapping[str, Rgb], changes: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Values of which JSON can be made; `changes` are those of the summary."""
    flags = SHARED_BIT * scene.is_shared + LANDMARK_BIT * scene.is_landmark
    return {
        'maps': _maps(scene, palette),
        'links': _links(scene, fusion),
        'sent': packed(scene.sent),
        'merged': packed(scene.merged),
        'owners': _text(scene.owners + flags),
        'floor': _floor(scene),
        'changes': _changes(scene, changes),
    }


def packed(points: Floats) -> dict[str, Any]:
    """Points (n, 3) as 16-bit numbers between their least and greatest coordinates."""
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else np.zeros((2, 3))
    step = np.maximum(high - low, 1e-9) / STEPS
    words = np.rint((points - low) / step)
    return {'low': low.tolist(), 'step': step.tolist(), 'data': _text(words)}


def _text(words: Floats | Ints) -> str:
    return base64.b64encode(words.astype('<u2').tobytes()).decode()


def _maps(scene: Scene, palette: Mapping[str, Rgb]) -> list[dict[str, Any]]:
    """Name, state, colour and middle of every sub-map that is drawn."""
    return [
        {
            'name': item.submap.map_id,
            'state': item.state.name.lower(),
            'colour': palette[item.submap.map_id],
            'sent': _middle(scene.sent[scene.owners == k]),
            'merged': _middle(scene.merged[scene.owners == k]),
        }
        for k, item in enumerate(scene.alignments)
    ]


def _middle(points: Floats) -> list[float]:
    return np.median(points, axis=0).tolist() if len(points) else [0.0, 0.0, 0.0]


def _links(scene: Scene, fusion: Fusion) -> list[list[int]]:
    """Two sub-maps by number, and their landmarks in common; 0 = undecided."""
    numbers = {item.submap.map_id: k for k, item in enumerate(scene.alignments)}
    links = [
        [numbers[a], numbers[b], count]
        for (a, b), count in common_landmarks(fusion).items()
        if a in numbers and b in numbers
    ]
    return sorted(links, key=lambda link: (-link[2], link))[:MAX_LINKS]


def square_size(scene: Scene) -> float:
    """Side of a square of the floor: a round number of global units."""
    wanted = 2.0 * scene.viewpoint.radius / SQUARES
    power = 10.0 ** math.floor(math.log10(wanted))
    return float(power * max(step for step in (1, 2, 5) if step * power <= wanted))


def _floor(scene: Scene) -> dict[str, Any] | None:
    """Squares under the merged map; None where there is none."""
    inside = [k for k, item in enumerate(scene.alignments) if item.component == 0]
    points = scene.merged[np.isin(scene.owners, inside)]
    if not len(points):
        return None
    step = square_size(scene) / scene.viewpoint.radius
    low, high = np.percentile(points, [2.0, 98.0], axis=0)
    return {
        'low': np.floor(low[:2] / step).astype(int).tolist(),
        'high': np.ceil(high[:2] / step).astype(int).tolist(),
        'step': step,
        'height': float(low[2]),
    }


def _changes(scene: Scene, changes: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Arrows and ellipsoids; the order is that of the summary."""
    if not changes:
        return []
    view = scene.viewpoint
    tips = view.points(np.array([change['position'] for change in changes]))
    shafts = view.directions(np.array([change['displacement'] for change in changes]))
    covariances = view.covariances(np.array([change['covariance'] for change in changes]))
    return [
        {
            'from': (tip - shaft).tolist(),
            'to': tip.tolist(),
            'covariance': covariance.tolist(),
            'p': change['p_value'],
            'object': change['object'] or 0,
        }
        for change, tip, shaft, covariance in zip(changes, tips, shafts, covariances, strict=True)
    ]
