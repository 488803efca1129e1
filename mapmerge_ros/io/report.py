# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one page, nothing outside it, about one fusion."""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup

from mapmerge_ros.fusion import Fusion
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io.change_words import chance, motion, nothing_moved, split_ids
from mapmerge_ros.io.comparison import TruthComparison
from mapmerge_ros.io.drawing import density, top_view
from mapmerge_ros.io.drawing_graph import map_graph
from mapmerge_ros.io.map_points import map_points
from mapmerge_ros.io.match_rows import log_nfa, tally, why_not, worth_showing
from mapmerge_ros.io.moved_objects import moved_objects
from mapmerge_ros.io.palette import Rgb, hexadecimal, map_colours
from mapmerge_ros.io.report_values import p_value, short, value
from mapmerge_ros.io.scene import Scene, make_scene
from mapmerge_ros.io.scene_data import scene_data, square_size
from mapmerge_ros.io.wording import against_truth, belief, counted, headline, left_out, what_moved

MAX_MATRIX = 16
"""Sub-maps up to which the pairs are shown as a matrix; a phone shows no more."""
MAX_PAIRS = 40
MAX_CHANGES = 200
"""Rows of the table of single landmarks that moved."""

SCRIPTS = ('viewer.js', 'scenes.js', 'hands.js', 'start.js')
"""In the order in which a page needs them."""

_BECAME = {'REFUSED': 'was refused', 'DETACHED': 'stays apart', 'QUARANTINED': 'is quarantined'}


def report_html(
    fusion: Fusion, summary: Mapping[str, Any], title: str, truth: TruthComparison | None = None
) -> bytes:
    """Page about a fusion; `summary` is that of `summarise`."""
    scene, script = make_scene(fusion), _script()
    is_merged = bool(fusion.components) and len(fusion.components[0].map_ids) > 1
    matches = worth_showing(fusion.matches)
    numbers = {(match.a, match.b): k for k, match in enumerate(fusion.matches)}
    page = _template().render(
        title=title,
        policy=_policy(script),
        css=_asset('report.css'),
        script=script,
        headline=headline(fusion),
        belief=belief(fusion.verdict) if is_merged else '',
        changed=what_moved(fusion),
        mood=_mood(fusion, is_merged),
        left_out=left_out(fusion),
        truth=against_truth(truth) if truth else '',
        is_merged=is_merged,
        **_pictures(fusion, scene, summary),
        **_changes(fusion, scene),
        density=Markup(density(fusion.verdict, _redundancy(fusion))),
        chance=chance(fusion.verdict.p_value),
        pairs=sorted(fusion.pairs, key=lambda pair: (-pair.shared, pair.a, pair.b))[:MAX_PAIRS],
        matrix=_matrix(fusion),
        graph=Markup(map_graph(fusion)),
        tally=tally(fusion.matches),
        matches=[(numbers[match.a, match.b], match) for match in matches],
        summary=summary,
        value=partial(value, summary),
    )
    return (page + '\n').encode()


def _pictures(fusion: Fusion, scene: Scene, summary: Mapping[str, Any]) -> dict[str, Any]:
    """What the template needs for the map, in three dimensions and as a drawing."""
    robots = {item.submap.map_id: item.submap.robot_id for item in fusion.alignments}
    palette = map_colours(robots)
    by_robot = len(set(robots.values())) > 1
    points = map_points(fusion)
    gauge = fusion.components[0].gauge if fusion.components else Gauge.SIMILARITY
    colours = [palette[map_id] for map_id in points.map_ids]
    unit = 'm' if gauge <= Gauge.RIGID else 'map units'
    return {
        'scene': scene_data(scene, fusion, palette, summary['changes']),
        'drawn_points': len(scene.owners),
        'total_points': scene.total,
        'top_view': Markup(top_view(points, gauge, colours)),
        'gauge': int(gauge),
        'legend': _legend(scene, palette, by_robot),
        'legend_of': 'robot' if by_robot else 'sub-map',
        'square': f'{square_size(scene):g} {unit}',
    }


def _legend(
    scene: Scene, palette: Mapping[str, Rgb], by_robot: bool
) -> list[tuple[str, str, list[int]]]:
    """Name, colour and sub-maps, by their number in the scene, of every robot."""
    rows: dict[str, tuple[str, list[int]]] = {}
    for k, item in enumerate(scene.alignments):
        name = item.submap.robot_id if by_robot else item.submap.map_id
        colour = hexadecimal(palette[item.submap.map_id])
        rows.setdefault(name, (colour, []))[1].append(k)
    return [(name, *row) for name, row in sorted(rows.items())]


def _changes(fusion: Fusion, scene: Scene) -> dict[str, Any]:
    gauge = fusion.components[0].gauge if fusion.components else Gauge.SIMILARITY
    doubtful = sum(not change.object_id for change in fusion.changes)
    return {
        'unmoved': nothing_moved(fusion),
        'split': split_ids(fusion),
        'objects': [
            {
                'number': each.number,
                'count': each.count,
                'map_id': each.map_id,
                'motion': motion(each, gauge, scene.viewpoint.radius),
                'chance': chance(each.p_value),
                'p_value': each.p_value,
            }
            for each in moved_objects(fusion.changes)
        ],
        'doubtful': counted(doubtful, 'single landmark') if doubtful else '',
        'max_changes': MAX_CHANGES,
    }


def _mood(fusion: Fusion, is_merged: bool) -> str:
    if not is_merged:
        return 'neutral'
    return 'good' if fusion.verdict.accepted else 'bad'


def _redundancy(fusion: Fusion) -> int:
    """Redundancy that the test's σ rests on: that of the sub-maps which do not know theirs."""
    return sum(
        item.submap.redundancy
        for item in fusion.alignments
        if item.component == 0 and item.submap.sigma == 0.0
    )


def _matrix(fusion: Fusion) -> list[tuple[str, list[int | None]]]:
    """Shared landmarks, a row for each sub-map; empty where there are too many for a matrix."""
    names = [item.submap.map_id for item in fusion.alignments]
    if len(names) > MAX_MATRIX:
        return []
    shared = {frozenset((pair.a, pair.b)): pair.shared for pair in fusion.pairs}
    return [
        (a, [None if a == b else shared.get(frozenset((a, b)), 0) for b in names]) for a in names
    ]


def _asset(name: str) -> Markup:
    """Text of a file beside the template, which goes into the page as it is."""
    path = resources.files('mapmerge_ros.io') / 'templates' / name
    return Markup(path.read_text('utf-8').strip())


def _script() -> Markup:
    return Markup('\n').join(_asset(name) for name in SCRIPTS)


def _policy(script: str) -> str:
    """Nothing from outside, and no script but this one, whatever the names in the data are."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"


def _length(vector: Sequence[float]) -> float:
    return math.hypot(*vector)


@lru_cache(maxsize=1)
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('mapmerge_ros.io'),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    # A zero-width space: a column of numbers need not be as wide as its map_id.
    environment.filters['breakable'] = lambda name: name.replace('/', '/\u200b')
    environment.filters['became'] = lambda state: _BECAME.get(state, f'is {state.lower()}')
    environment.filters.update(
        log_nfa=log_nfa, why_not=why_not, short=short, p_value=p_value, length_of=_length
    )
    return environment.get_template('report.html')
