# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which sub-maps hang together: links between pairs, and the components they form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.errors import DegenerateGeometry, InvalidValue
from mapmerge_ros.fusion.associate import Association
from mapmerge_ros.fusion.config import FusionConfig
from mapmerge_ros.fusion.wrong_ids import rows_apart
from mapmerge_ros.geometry import (
    FrameGraph,
    Gauge,
    Segments,
    Similarity,
    align,
    align_robustly,
)
from mapmerge_ros.submap import SubMap


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """The rotation between two sub-maps that their common landmarks determine worst."""

    axis_a: Floats
    """(3,) unit vector along which the landmarks are spread most, frame of a"""
    pivot_a: Floats
    """(3,) middle of the landmarks"""
    std_rad: float
    """Median distance of the landmarks after alignment, over their spread about the axis"""


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """Two sub-maps (by index, a < b) that share landmarks."""

    a: int
    b: int
    shared: int
    S_a_b: Similarity | None
    """None when the pair alone does not determine its frames"""
    reason: str = ''
    """Why not; empty for a usable link"""
    turn: Turn | None = None
    """Rotation that the pair determines worst; None when the link is not usable"""
    contradicting: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """Tracks that these two sub-maps place too far apart to be one point"""


def components(count: int, links: Sequence[Link]) -> tuple[tuple[int, ...], ...]:
    """Sub-maps connected by usable links, largest first, then in order of their first map."""
    return tuple(sorted(_graph(count, links).components(), key=lambda group: (-len(group), group)))


def spanning_tree(
    maps: Sequence[int], gauges: Sequence[Gauge], links: Sequence[Link]
) -> tuple[int, dict[int, Similarity]]:
    """
    Centre of a component, and S_centre_k along shortest paths.

    The length of a link is the variance of its worst rotation: one that hangs on a few landmarks
    along a line is walked last (1 / shared alone starts one in thirty narrow rooms wrongly).

    The centre is among the sub-maps of the smallest gauge: its scale and heading are real.
    """
    graph = _graph(len(gauges), links)
    smallest = min(gauges[k] for k in maps)
    centre = graph.centre([k for k in maps if gauges[k] == smallest], maps)
    return centre, graph.frames_from(centre)


def _graph(count: int, links: Sequence[Link]) -> FrameGraph:
    usable = {(link.a, link.b): link for link in links if link.S_a_b is not None}
    known = {pair: link.S_a_b for pair, link in usable.items() if link.S_a_b is not None}
    return FrameGraph(count, known, [_length(link) for link in usable.values()])


def _length(link: Link) -> float:
    # Exact data have no spread; their links are then told apart by the number of landmarks.
    variance = link.turn.std_rad**2 if link.turn else 0.0
    return (variance + 1e-9) / link.shared


def link_pair(
    submaps: Sequence[SubMap],
    association: Association,
    weights: Sequence[Floats],
    pair: tuple[int, int],
    config: FusionConfig,
) -> Link:
    """Link of two sub-maps, and why it is none; `weights` holds those of all sub-maps."""
    a, b = pair
    common, rows_a, rows_b = np.intersect1d(
        association.tracks[a], association.tracks[b], assume_unique=True, return_indices=True
    )
    if len(common) < config.min_shared:
        reason = f'{len(common)} landmarks in common, {config.min_shared} needed'
        return Link(a, b, len(common), None, reason)
    points_a, points_b = submaps[a].compressed_points[rows_a], submaps[b].compressed_points[rows_b]
    gauge = max(submaps[a].gauge, submaps[b].gauge)
    try:
        ratio = align(points_a, points_b, gauge=gauge).S_target_source.scale
        precision = harmonic(weights[a][rows_a], weights[b][rows_b] / ratio**2)
        S_a_b = align_robustly(points_a, points_b, gauge=gauge, weights=precision).S_target_source
    except DegenerateGeometry as err:
        return Link(a, b, len(common), None, str(err))
    except (np.linalg.LinAlgError, ArithmeticError, InvalidValue):
        return Link(a, b, len(common), None, 'their positions cannot be computed with')
    moved_b = S_a_b.apply(points_b)
    pair_alone = Segments.of_lengths([len(common)])
    apart = rows_apart(points_a, moved_b, precision, pair_alone, config)
    turn = _worst_turn(points_a, moved_b)
    return Link(a, b, len(common), S_a_b, turn=turn, contradicting=common[apart])


def _worst_turn(points_a: Floats, points_b: Floats) -> Turn:
    centred = points_a - points_a.mean(axis=0)
    _, spreads, axes = np.linalg.svd(centred, full_matrices=False)
    across = np.sqrt((spreads[1] ** 2 + spreads[2] ** 2) / len(points_a))
    distance = np.median(np.linalg.norm(points_a - points_b, axis=1))
    return Turn(axes[0], points_a.mean(axis=0), float(distance / across))


def harmonic(weights_a: Floats, weights_b: Floats) -> Floats:
    """Weight of a difference; zero where one side is not determined at all."""
    total = weights_a + weights_b
    return np.divide(weights_a * weights_b, total, out=np.zeros_like(total), where=total > 0.0)
