# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Drawings of the report: SVG that stands inside a page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.distributions import PriceLaw
from mapmerge_ros.fusion import Verdict
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io.map_points import SEVERAL, MapPoints
from mapmerge_ros.io.palette import SHARED, Rgb, hexadecimal
from mapmerge_ros.io.viewpoint import viewpoint

WIDTH, MIN_HEIGHT, MAX_HEIGHT = 720.0, 220.0, 760.0
MAX_POINTS = 6000
"""Drawn points: 60 kB of report, and more cannot be told apart."""

OUTER_PERCENT = 1.0
"""Share of the points on either side that may lie outside the drawing: SLAM maps have strays."""

MAX_SPREADS = 12.0
"""Standard deviations right of the mean up to which the density is drawn to scale."""


def top_view(points: MapPoints, gauge: Gauge, palette: Sequence[Rgb]) -> str:
    """
    Map seen from above, or, where up is unknown, along its thinnest direction.

    `palette` has a colour for each sub-map. A scale bar is there if the map is metric.
    """
    if not len(points):
        return ''
    view = viewpoint(points.points_global, gauge)
    flat = view.radius * view.points(points.points_global)[:, :2]
    low, high = _frame(flat)
    scale = min(WIDTH / (high - low)[0], MAX_HEIGHT / (high - low)[1])
    height = max(MIN_HEIGHT, float((high - low)[1] * scale))
    shift = (np.array([WIDTH, height]) - scale * (high - low)) / 2.0
    pixels = (flat - low) * scale + shift
    pixels[:, 1] = height - pixels[:, 1]
    inside = ((pixels >= 0.0) & (pixels <= [WIDTH, height])).all(axis=1)
    rows = np.flatnonzero(inside)
    drawn = rows[np.linspace(0, len(rows) - 1, min(len(rows), MAX_POINTS)).astype(int)]
    bar = _scale_bar(scale, height) if gauge <= Gauge.RIGID else ''
    return svg(height, 'map seen from above', *_dots(points, pixels, drawn, palette), bar)


def _frame(flat: Floats) -> tuple[Floats, Floats]:
    low, high = np.percentile(flat, [OUTER_PERCENT, 100.0 - OUTER_PERCENT], axis=0)
    margin = 0.06 * max(float((high - low).max()), 1e-9)
    return low - margin, high + margin


def _dots(points: MapPoints, pixels: Floats, drawn: Ints, palette: Sequence[Rgb]) -> list[str]:
    """Paths of dots, one for each colour and size; shared landmarks last, on top."""
    is_landmark = np.arange(len(points)) < points.landmark_count
    owners = [*range(len(points.map_ids)), SEVERAL]
    paths = []
    for landmark, size, opacity in ((False, 3.2, 0.65), (True, 4.6, 0.9)):
        for owner in owners:
            rows = drawn[(points.owners[drawn] == owner) & (is_landmark[drawn] == landmark)]
            colour = hexadecimal(SHARED if owner == SEVERAL else palette[owner])
            strokes = ''.join(f'M{x:.1f} {y:.1f}h0' for x, y in pixels[rows])
            if strokes:
                paths.append(
                    f'<path d="{strokes}" stroke="{colour}" stroke-width="{size}" '
                    f'stroke-opacity="{opacity}" stroke-linecap="round" fill="none"/>'
                )
    return paths


def _scale_bar(scale: float, height: float) -> str:
    """Bar of a round number of metres, about a fifth of the width."""
    wanted = 0.2 * WIDTH / scale
    power = 10.0 ** np.floor(np.log10(wanted))
    metres = float(power * max(step for step in (1, 2, 5) if step * power <= wanted))
    end, y = 16.0 + metres * scale, height - 14.0
    return (
        f'<path d="M16 {y - 5:.1f}V{y:.1f}H{end:.1f}V{y - 5:.1f}" class="ink" fill="none"/>'
        f'<text x="{(16 + end) / 2:.1f}" y="{y - 8:.1f}" text-anchor="middle">{metres:g} m</text>'
    )


def density(verdict: Verdict, redundancy: int) -> str:
    """
    Expected price of merging if nothing is wrong, and the one that was found.

    The price is ã/σ², or, where the test rests on fitted errors, what it is in units of those.
    `redundancy` is what an estimated σ rests on; 0 = σ is known.
    """
    found, dof = price_and_expected(verdict)
    if not dof or not np.isfinite(found):
        return ''
    law = PriceLaw(dof, max(redundancy, 5) if redundancy else np.inf)
    mean, spread = law.mean, law.std
    low = max(0.0, min(mean - 5.0 * spread, found - spread))
    high = min(max(mean + 5.0 * spread, found + spread), mean + MAX_SPREADS * spread)
    values = np.linspace(low, high, 300)
    heights = law.density(values)
    heights = heights / heights[np.isfinite(heights)].max()
    right, base = WIDTH - 20.0, 190.0
    x = 20.0 + (values - low) / (high - low) * (right - 20.0)
    y = base - 150.0 * np.nan_to_num(heights, posinf=1.0)
    curve = 'L'.join(f'{a:.1f} {b:.1f}' for a, b in zip(x, y, strict=True))
    at = 20.0 + (min(found, high) - low) / (high - low) * (right - 20.0)
    middle = 20.0 + (mean - low) / (high - low) * (right - 20.0)
    return svg(
        222.0,
        f'price of merging: {mean:.0f} expected, {found:.0f} found',
        f'<path d="M20 {base}L{curve}L{right} {base}Z" class="expected"/>',
        f'<path d="M20 {base}H{right}" class="ink"/>',
        f'<text x="{middle:.1f}" y="{base + 22}" text-anchor="middle">expected {mean:.0f}</text>',
        *_mark(at, found, base, found > high, verdict.accepted),
    )


def price_and_expected(verdict: Verdict) -> tuple[float, int]:
    """Price that the p-value is about, and how much of it is expected."""
    if verdict.errors is not None and verdict.errors.dof:
        return verdict.errors.price, verdict.errors.dof
    return verdict.variance_factor * verdict.dof, verdict.dof


def _mark(at: float, found: float, base: float, beyond: bool, accepted: bool) -> Sequence[str]:
    kind = 'good' if accepted else 'bad'
    anchor = 'end' if at > WIDTH / 2.0 else 'start'
    offset = -8.0 if anchor == 'end' else 8.0
    arrow = ' →' if beyond else ''
    return (
        f'<path d="M{at:.1f} 12V{base}" class="{kind}"/>',
        f'<text x="{at + offset:.1f}" y="28" text-anchor="{anchor}" class="{kind}">'
        f'found {found:.0f}{arrow}</text>',
    )


def svg(height: float, title: str, *parts: str) -> str:
    """Return a drawing as wide as the page; the parts are markup already."""
    return (
        f'<svg viewBox="0 0 {WIDTH:g} {height:.0f}" role="img" aria-label="{title}" '
        f'xmlns="http://www.w3.org/2000/svg">{"".join(parts)}</svg>'
    )
