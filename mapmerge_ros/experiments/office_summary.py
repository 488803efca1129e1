# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the runs of `office` say together: distances, their errors, sizes of the Jacobians."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mapmerge_ros.arrays import Floats, Ints
from mapmerge_ros.experiments.figures import (
    FULL,
    OURS,
    PROCRUSTES,
    SINGLE,
    label,
    new_figure,
)
from mapmerge_ros.experiments.office_site import COMMON
from mapmerge_ros.experiments.result import Check, Results, Summary, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MERGE_SIZE = (288, 100)
"""The paper's table: 4 x 72 rows; 72 landmark coordinates and 4 x 7 of the transforms."""
FULL_SIZE = (49600, 8997)

METHODS = ('one', 'procrustes', 'ours', 'full')
TITLES = ('one map', 'Procrustes', 'ours', 'full bundle')
COLOURS = (SINGLE, PROCRUSTES, OURS, FULL)


def all_pairs() -> Ints:
    """Every pair of common landmarks, (276, 2), each ascending."""
    return np.column_stack(np.triu_indices(COMMON, 1))


def errors_mm(results: Results) -> tuple[Floats, Ints]:
    """RMS error over the runs of all 276 distances [mm], (methods, 276); rows of the five."""
    truth = np.array(results.values[0]['truth'])
    rms = [np.sqrt(np.mean((results.column(name) - truth) ** 2, axis=0)) for name in METHODS]
    pairs = np.sort(np.array(results.values[0]['pairs']), axis=1)
    listed = [int(np.flatnonzero((all_pairs() == pair).all(axis=1))[0]) for pair in pairs]
    return 1e3 * np.array(rms), np.array(listed)


def summarise(results: Results) -> Summary:
    """The paper's table for the first run, errors over all runs, sizes of the Jacobians."""
    rms, listed = errors_mm(results)
    first = results.values[0]
    rows = [
        (
            *(str(first['ids'][i]) for i in pair),
            *(f'{1e3 * first[name][k]:.1f}' for name in (*METHODS, 'truth')),
            *(f'{rms[m, k]:.1f}' for m in range(len(METHODS))),
        )
        for pair, k in zip(first['pairs'], listed, strict=True)
    ]
    columns = (
        '#pt 1',
        '#pt 2',
        *(f'#{title}' for title in (*TITLES, 'truth')),
        *(f'#RMS {title}' for title in TITLES),
    )
    _, procrustes, ours, full = rms
    share = float(np.mean(ours < procrustes))
    sizes = tuple(int(v) for v in first['merge_size']), tuple(int(v) for v in first['full_size'])
    checks = (
        Check(
            'every listed distance closer to truth than with Procrustes',
            '5 of 5',
            f'{np.count_nonzero(ours[listed] < procrustes[listed])} of {len(listed)}',
            bool((ours[listed] < procrustes[listed]).all()),
        ),
        Check('merge Jacobian', '288 × 100', '{} × {}'.format(*sizes[0]), sizes[0] == MERGE_SIZE),
        Check(
            'Jacobian of the full bundle',
            '49600 × 8997',
            '{} × {}'.format(*sizes[1]),
            sizes[1] == FULL_SIZE,
        ),
    )
    notes = (
        f'of all {len(ours)} distances, {share:.1%} are closer to truth than with Procrustes',
        f'RMS error over all distances [mm]: one map {_mean(rms[0]):.1f}, '
        f'Procrustes {_mean(procrustes):.1f}, ours {_mean(ours):.1f}, '
        f'full bundle {_mean(full):.1f}',
        f'merge accepted in {results.share(results.column("accepted") > 0):.1%} of the runs',
        f'{int(results.column("retakes").sum())} runs were recorded again: a point of a weak '
        'track had ended behind a camera',
        'every map is brought to the scale of truth by a similarity over its 24 landmarks',
    )
    return Summary(
        (Table('Distances [mm]: first run, and RMS error of all runs', columns, tuple(rows)),),
        checks,
        notes,
    )


def _mean(rms: Floats) -> float:
    return float(np.sqrt(np.mean(rms**2)))


def draw(results: Results) -> Figure:
    """Errors of the five distances, and of all of them."""
    figure = new_figure(columns=2)
    few, many = figure.axes
    rms, listed = errors_mm(results)
    first, at = results.values[0], np.arange(len(listed))
    for m, (title, colour) in enumerate(zip(TITLES, COLOURS, strict=True)):
        few.bar(at + 0.2 * (m - 1.5), rms[m, listed], 0.2, color=colour, label=title)
        many.plot(np.sort(rms[m]), np.linspace(0, 1, len(rms[m])), color=colour, label=title)
    names = ['{}–{}'.format(*(first['ids'][i] for i in pair)) for pair in first['pairs']]
    few.set_xticks(at, names)
    few.set_yscale('log')
    many.set_xscale('log')
    label(few, 'pair of landmarks', 'RMS error [mm]', 'The five distances')
    label(many, 'RMS error [mm]', 'share of distances', f'All {rms.shape[1]} distances')
    return figure
