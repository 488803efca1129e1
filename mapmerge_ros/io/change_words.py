# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What moved, in sentences for someone who is not a statistician."""

from __future__ import annotations

import math
from collections import Counter

from mapmerge_ros.fusion import Fusion, State
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.io.moved_objects import MovedTogether
from mapmerge_ros.io.wording import counted

MAX_PAIRS = 6
"""Pairs of sub-maps that are named one by one."""

CERTAIN = 1e-9
"""p-value below which chance is no longer put into numbers."""

_PLACES = ((1e-3, 'in a thousand'), (1e-6, 'in a million'), (CERTAIN, 'in a thousand million'))


def nothing_moved(fusion: Fusion) -> str:
    """Say plainly that nothing moved, or why nobody can say; empty where something did."""
    if fusion.changes:
        return ''
    if len(fusion.in_state(State.MERGED)) < 2:
        return 'Nothing can be said: there are no two sub-maps of one place to compare.'
    component = fusion.components[0]
    count = len(component.landmarks.ids)
    if component.examination is None or component.examination.tests is None:
        return (
            f'No single landmark was tested: {count} landmarks are too many for that. '
            'The test of the whole map, below, is all there is.'
        )
    if not component.verdict.accepted:
        return (
            'Nothing can be named: the merge as a whole is not believed, yet no object and no '
            'single landmark stands out as the cause.'
        )
    if alone := len(component.examination.doubtful):
        return (
            f'Nothing moved together. {counted(alone, "single landmark")} did not fit (a wrong '
            'match or a bad track is as likely as motion).'
        )
    known = 'Nothing moved.' if not fusion.contradictions else 'No merged landmark moved.'
    return (
        f'{known} Each of the {counted(count, "landmark")} that several sub-maps have was '
        'tested by itself, and each group of neighbours together: none is farther off than its '
        'own uncertainty explains.'
    )


def split_ids(fusion: Fusion) -> str:
    """Tell ids that two sub-maps give to points far apart: wrong, or moved farther than noise."""
    counts = Counter((each.a, each.b) for each in fusion.contradictions)
    if not counts:
        return ''
    pairs = [f'{count} of {a} and {b}' for (a, b), count in counts.most_common(MAX_PAIRS)]
    if len(counts) > MAX_PAIRS:
        pairs.append(f'and of {counted(len(counts) - MAX_PAIRS, "more pair")}')
    return (
        'Landmark ids that two sub-maps give to points too far apart to be one: '
        f'{"; ".join(pairs)}. Either the ids are wrong, or something was moved far. They were '
        'not merged.'
    )


def motion(moved: MovedTogether, gauge: Gauge, radius: float) -> str:
    """Say how an object moved; `radius` is that of the scene."""
    unit = 'm' if gauge <= Gauge.RIGID else 'map units'
    text = f'moved by {moved.distance:.3g} ± {2.0 * moved.distance_std:.2g} {unit}'
    text += f' ({moved.distance / radius:.1%} of the radius of the scene)'
    if gauge <= Gauge.YAW_TRANSLATION:
        text += f', {_vertically(moved)}'
    if moved.turn_rad:
        text += f', and turned by about {math.degrees(moved.turn_rad):.2g}°'
    return text


def chance(p_value: float) -> str:
    """Say how often chance alone does as much, if nothing is wrong."""
    if p_value > 0.95:
        return 'nearly always'
    if p_value >= 0.01:
        return f'{counted(max(1, round(100 * p_value)), "time")} in a hundred'
    for limit, words in _PLACES:
        if p_value >= limit:
            return f'{counted(max(1, round(p_value / limit)), "time")} {words}'
    return 'practically never'


def _vertically(moved: MovedTogether) -> str:
    """Which part of a motion is up or down, where up is known."""
    x, y, up = moved.displacement_global.tolist()
    level = math.hypot(x, y)
    if abs(up) < 0.1 * level:
        return 'level'
    return f'of which {abs(up):.3g} m {"up" if up > 0.0 else "down"}'
