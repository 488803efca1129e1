# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The graph of the sub-maps: which have landmarks in common, which may have some."""

from __future__ import annotations

import math

from markupsafe import escape

from mapmerge_ros.association import Decision
from mapmerge_ros.fusion import Fusion
from mapmerge_ros.io.drawing import WIDTH, svg
from mapmerge_ros.io.palette import SHARED, Rgb, hexadecimal, map_colours

MAX_NODES = 16
"""More names would lie on each other on a phone."""
MAX_NAME = 16
"""Letters of a name beside its node, at the size that a phone needs."""
RADIUS, NODE, MARGIN = 130.0, 10.0, 20.0
WIDTHS = (1.5, 9.0)
"""Of the line of a single landmark in common, and of the most of them."""

_Edges = dict[tuple[str, str], int]


def map_graph(fusion: Fusion) -> str:
    """
    Sub-maps in a circle: lines between those with landmarks in common, dotted where undecided.

    Empty where there is nothing to join, or too much to read.
    """
    names = [item.submap.map_id for item in fusion.alignments]
    edges = common_landmarks(fusion)
    if not 2 < len(names) <= MAX_NODES or not edges:
        return ''
    places = {name: _place(k, len(names)) for k, name in enumerate(names)}
    top, bottom = (edge(y for _, y in places.values()) for edge in (min, max))
    places = {name: (x, y - top + MARGIN) for name, (x, y) in places.items()}
    palette = map_colours({x.submap.map_id: x.submap.robot_id for x in fusion.alignments})
    inside = fusion.components[0].map_ids if fusion.components else ()
    most = max(edges.values())
    lines = [_line(places[a], places[b], count, most) for (a, b), count in sorted(edges.items())]
    nodes = [_node(name, places[name], _colour(name in inside, palette[name])) for name in names]
    return svg(
        bottom - top + 2.0 * MARGIN, 'sub-maps and what they have in common', *lines, *nodes
    )


def common_landmarks(fusion: Fusion) -> _Edges:
    """Landmarks in common of every pair that has some; 0 for undecided pairs."""
    edges = {
        (match.a, match.b): match.links
        for match in fusion.matches
        if match.links or match.found.decision is Decision.UNDECIDED
    }
    for pair in fusion.pairs:
        if pair.shared and (pair.b, pair.a) not in edges:
            edges.setdefault((pair.a, pair.b), pair.shared)
    return edges


def _colour(is_inside: bool, colour: Rgb) -> str:
    """What is not in the published map is grey."""
    return hexadecimal(colour if is_inside else SHARED)


def _place(k: int, count: int) -> tuple[float, float]:
    angle = 2.0 * math.pi * (k + 0.5) / count - math.pi / 2.0
    return WIDTH / 2.0 + RADIUS * math.cos(angle), RADIUS * math.sin(angle)


def _line(a: tuple[float, float], b: tuple[float, float], count: int, most: int) -> str:
    ends = f'x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}"'
    if not count:
        return f'<line {ends} stroke-width="3" class="undecided"/>'
    thin, thick = WIDTHS
    width = thin + (thick - thin) * math.sqrt(count / most)
    return f'<line {ends} stroke-width="{width:.1f}" stroke-opacity="0.45"/>'


def _node(name: str, place: tuple[float, float], colour: str) -> str:
    x, y = place
    right = x >= WIDTH / 2.0
    anchor, offset = ('start', 1.8 * NODE) if right else ('end', -1.8 * NODE)
    short = name if len(name) <= MAX_NAME else f'…{name[1 - MAX_NAME :]}'
    return (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{NODE}" fill="{colour}"/>'
        f'<text x="{x + offset:.1f}" y="{y + 5:.1f}" text-anchor="{anchor}">{escape(short)}</text>'
    )
