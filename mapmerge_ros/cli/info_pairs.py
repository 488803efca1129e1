# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which sub-maps of a recording show the same place: the tables of `mapmerge info`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from rich.console import Console

from mapmerge_ros.cli import console
from mapmerge_ros.fusion import Pair
from mapmerge_ros.fusion.outcome import Match
from mapmerge_ros.io.match_rows import (
    by_worth,
    inliers_of,
    log_nfa,
    tally,
    why_not,
    worth_showing,
)
from mapmerge_ros.submap import DescriptorType, SubMap

MAX_PAIRS = 40
"""Rows of the table of equal ids; the strongest come first."""

LEGEND = (
    'inliers: how many of the candidates (landmarks that look alike) one alignment explains; '
    'log NFA: -5 is one false alarm in 100 000 such pairs; common: landmarks that both have, '
    'after a second look at the aligned maps.'
)


def show_shared(screen: Console, submaps: Sequence[SubMap], pairs: Sequence[Pair]) -> None:
    """Show which sub-maps of one id space have ids in common."""
    spaces = Counter(submap.id_space for submap in submaps if submap.id_space)
    if not pairs:
        if max(spaces.values(), default=0) > 1:
            screen.print('No two sub-maps of one id space have a compressed landmark in common.')
        return
    shown = console.table('sub-map', 'sub-map', '#shared')
    for pair in pairs[:MAX_PAIRS]:
        shown.add_row(pair.a, pair.b, str(pair.shared))
    if len(pairs) > MAX_PAIRS:
        shown.caption = f'{len(pairs) - MAX_PAIRS} weaker pairs not shown'
    screen.print('Shared: compressed landmarks of equal id in one id space.')
    screen.print(shown)


def show_matches(
    screen: Console, submaps: Sequence[SubMap], matches: Sequence[Match], *, everything: bool
) -> None:
    """Show what descriptors and geometry say about all other pairs, and why not."""
    if matches:
        rows = by_worth(matches) if everything else worth_showing(matches)
        shown = console.table('sub-map', 'sub-map', '#inliers', '#log NFA', '#common', 'decision')
        for row in rows:
            decision = row.found.decision.value
            shown.add_row(row.a, row.b, inliers_of(row), log_nfa(row), str(row.links), decision)
        screen.print(tally(matches))
        screen.print(shown)
        screen.print(LEGEND)
        for row in rows:
            if reason := why_not(row):
                decision = row.found.decision.value
                screen.print(f'{row.a} – {row.b} {decision}: {reason}', soft_wrap=True)
        if len(rows) < len(matches):
            hidden = len(matches) - len(rows)
            screen.print(f'{hidden} more pairs are apart or weaker: --all-pairs shows them.')
    for line in _alone(submaps):
        screen.print(line, soft_wrap=True)


def _alone(submaps: Sequence[SubMap]) -> list[str]:
    """Sub-maps that cannot be compared, and those that wait to be asked."""
    lines = [
        f'{submap.map_id}: its landmark ids are private, and it has no descriptors: nothing '
        'tells what it has in common with others.'
        for submap in submaps
        if not submap.id_space and submap.descriptors.type is DescriptorType.NONE
    ]
    announced = [submap.map_id for submap in submaps if not submap.compressed_count]
    if announced:
        lines.append(
            f'Announced only: {", ".join(announced)}: nothing is compressed, so that the fusion '
            'node can choose what to ask for; a replay cannot merge it.'
        )
    return lines
