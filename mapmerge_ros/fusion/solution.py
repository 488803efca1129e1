# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Every landmark and frame of a component, found by one merge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapmerge_ros.arrays import Floats, Ints, Mask
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.element import Element, Placement
from mapmerge_ros.fusion.merge import Estimate
from mapmerge_ros.fusion.overlap import Link
from mapmerge_ros.fusion.search import search
from mapmerge_ros.fusion.verify import Noise, degrees_of_freedom, verify
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import SubMap


@dataclass(frozen=True, slots=True)
class Anchor:
    """The sub-map that holds a global frame still, and where it is in there."""

    map_id: str
    S_global_map: Similarity


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Every landmark and frame of the component, in the global frame; `reduced` as merged."""

    elements: tuple[Element, ...]
    reduced: tuple[Element, ...]
    points: Floats
    placements: tuple[Placement, ...]
    estimate: Estimate
    S_global_estimate: Similarity
    """From the frame of `estimate`"""
    dof: int
    rows: tuple[Ints, ...]
    """Per sub-map, rows of its shared landmarks among the compressed ones"""


def solve(
    submaps: Sequence[SubMap],
    association: Association,
    links: Sequence[Link],
    noise: Noise,
    anchor: Anchor,
    config: FusionConfig,
) -> Solution:
    """
    Merge sub-maps that hang together.

    Raises
    ------
    DegenerateGeometry
        A landmark or a frame is not determined.

    """
    gauge = min(submap.gauge for submap in submaps)
    views = association.views
    is_shared: Mask = views > 1 if len(submaps) > 1 else np.ones(association.count, bool)
    dof = degrees_of_freedom(views, [submap.gauge for submap in submaps], gauge)
    elements = tuple(
        Element.from_submap(submap, tracks, is_shared[tracks], float(weight))
        for submap, tracks, weight in zip(submaps, association.tracks, noise.weights, strict=True)
    )
    shared = np.flatnonzero(is_shared)
    slots = np.cumsum(is_shared) - 1
    reduced = [
        replace(element, tracks=slots[element.tracks])
        for element in (element.reduced() for element in elements)
    ]
    estimate = search(
        reduced,
        links,
        gauge,
        lambda price: verify(price, dof, noise, config).accepted,
        config,
    )

    points = np.full((association.count, 3), np.nan)
    points[shared] = estimate.points
    for element in elements:
        points[element.tracks[~element.is_shared]] = element.recover_private(points)
    held = [submap.map_id for submap in submaps].index(anchor.map_id)
    S_global_estimate = anchor.S_global_map @ elements[held].place(points).S_map_global
    points = S_global_estimate.apply(points)
    placements = tuple(element.place(points) for element in elements)
    return Solution(
        elements,
        tuple(reduced),
        points,
        placements,
        estimate,
        S_global_estimate,
        dof,
        tuple(np.flatnonzero(element.is_shared) for element in elements),
    )
