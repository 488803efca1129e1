# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`report.html`: one page, nothing outside it, about one fusion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import jinja2
from markupsafe import Markup

from mapmerge_ros.fusion import Fusion
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io.comparison import TruthComparison
from mapmerge_ros.io.drawing import density, top_view
from mapmerge_ros.io.drawing_graph import map_graph
from mapmerge_ros.io.map_points import map_points
from mapmerge_ros.io.match_rows import inliers_of, log_nfa, tally, why_not, worth_showing
from mapmerge_ros.io.palette import SHARED, colours, hexadecimal
from mapmerge_ros.io.wording import (
    against_truth,
    belief,
    headline,
    left_out,
    readable_bytes,
)

MAX_MATRIX = 16
"""Sub-maps up to which the pairs are shown as a matrix; a phone shows no more."""
MAX_PAIRS = 40


def report_html(
    fusion: Fusion, summary: Mapping[str, Any], title: str, truth: TruthComparison | None = None
) -> bytes:
    """Page about a fusion; `summary` is that of `summarise`."""
    points = map_points(fusion)
    gauge = fusion.components[0].gauge if fusion.components else Gauge.SIMILARITY
    is_merged = bool(fusion.components) and len(fusion.components[0].map_ids) > 1
    page = _template().render(
        title=title,
        headline=headline(fusion),
        belief=belief(fusion.verdict) if is_merged else '',
        mood=_mood(fusion, is_merged),
        left_out=left_out(fusion),
        truth=against_truth(truth) if truth else '',
        top_view=Markup(top_view(points, gauge)),
        above=gauge <= Gauge.YAW_TRANSLATION,
        gauge=int(gauge),
        legend=_legend(points.map_ids),
        shared_colour=hexadecimal(SHARED),
        density=Markup(density(fusion.verdict, _redundancy(fusion))),
        pairs=sorted(fusion.pairs, key=lambda pair: (-pair.shared, pair.a, pair.b))[:MAX_PAIRS],
        matrix=_matrix(fusion),
        graph=Markup(map_graph(fusion)),
        tally=tally(fusion.matches),
        matches=worth_showing(fusion.matches),
        summary=summary,
    )
    return (page + '\n').encode()


def _legend(map_ids: Sequence[str]) -> list[tuple[str, str]]:
    return [
        (map_id, hexadecimal(colour))
        for map_id, colour in zip(map_ids, colours(len(map_ids)), strict=True)
    ]


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


@lru_cache(maxsize=1)
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader('mapmerge_ros.io'),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters['bytes'] = readable_bytes
    # A zero-width space: a column of numbers need not be as wide as its map_id.
    environment.filters['breakable'] = lambda name: name.replace('/', '/\u200b')
    environment.filters.update(inliers=inliers_of, log_nfa=log_nfa, why_not=why_not)
    environment.filters['short'] = lambda value: '–' if value is None else f'{value:.4g}'
    return environment.get_template('report.html')
