# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Tables, checks and figure of the loop closure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mapmerge_ros.arrays import Floats, Mask
from mapmerge_ros.experiments.figures import (
    FULL,
    OURS,
    PAPER,
    PROCRUSTES,
    label,
    new_figure,
)
from mapmerge_ros.experiments.result import Check, Results, Summary, Table
from mapmerge_ros.experiments.room import WIDTHS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SUCCESS = 0.1
"""RMSE [m] below which the paper calls a merge successful"""

WRONG = 3.0
"""Times the full bundle's error above which a merge is a wrong one"""

GAPS = {'wide': 0.01, 'narrow': 0.03}
SIGNIFICANCE, COVERAGE = 0.01, 0.97

METHODS = (
    ('full', 'full bundle', '99.8 %', FULL),
    ('ours', 'ours', '80 %', OURS),
    ('open', 'ours, without 1-4', '25 %', PAPER),
    ('procrustes', 'Procrustes + averaging', '7.7 %', PROCRUSTES),
)

TABLE_I = (
    ('1', '3 082 x 660', '27 x 27'),
    ('2', '2 792 x 660', '24 x 24'),
    ('3', '3 140 x 660', '33 x 33'),
    ('4', '3 190 x 660', '36 x 36'),
    ('merge', '12 204 x 2 601', '120 x 88'),
)


def summarise(results: Results) -> Summary:
    """Success rates, what closing the loop gives, Jacobians; the claims."""
    return Summary(
        (_success(results), _closing(results), _jacobians(results)),
        (*_gaps(results), _wrong(results), *_coverage(results)),
    )


def _rates(results: Results, scene: str) -> dict[str, float]:
    return {
        name: results.share(results.column(f'{scene}_{name}') < SUCCESS) for name, *_ in METHODS
    }


def _success(results: Results) -> Table:
    rates = [_rates(results, scene) for scene in WIDTHS]
    rows = tuple(
        (text, paper, *(f'{own[name]:.1%}' for own in rates)) for name, text, paper, _ in METHODS
    )
    return Table(
        f'Share of runs with RMSE < {SUCCESS} m',
        ('', '#paper', *(f'#{scene} ({width} m)' for scene, width in WIDTHS.items())),
        rows,
    )


def _closing(results: Results) -> Table:
    columns = [_figures(results, scene) for scene in WIDTHS]
    paper = ('85 %', '80 %', '0.038', '', '', '', '', '', '')
    rows = tuple(
        (text, said, *(own[text] for own in columns))
        for text, said in zip(columns[0], paper, strict=True)
    )
    return Table('Closing the loop', ('', '#paper', *(f'#{scene}' for scene in WIDTHS)), rows)


def _figures(results: Results, scene: str) -> dict[str, str]:
    ours, unclosed, to_full, starts = (
        results.column(f'{scene}_{name}') for name in ('ours', 'open', 'to_full', 'starts')
    )
    accepted = results.column(f'{scene}_accepted') > 0.0
    wrong = _is_wrong(results, scene)
    good = ours[ours < SUCCESS]
    return {
        'improved by the 1-4 matches': f'{results.share(ours < unclosed):.1%}',
        'error halved by them': f'{results.share(ours <= 0.5 * unclosed):.1%}',
        'mean RMSE of the successful [m]': f'{good.mean():.4f}' if len(good) else '-',
        'median distance to the full bundle [m]': f'{np.median(to_full):.4f}',
        'accepted': f'{results.share(accepted):.1%}',
        'needed more than two starts': f'{results.share(starts > 2):.1%}',
        f'wrong (> {WRONG:g} x full bundle)': f'{np.count_nonzero(wrong)}',
        'truth within the ellipsoid of R̄': f'{_covered(results, scene, "p_reported"):.1%}',
        'truth within the 99 % region of the cost': f'{_covered(results, scene, "p_cost"):.1%}',
    }


def _is_wrong(results: Results, scene: str) -> Mask:
    return results.column(f'{scene}_ours') > WRONG * results.column(f'{scene}_full')


def _covered(results: Results, scene: str, name: str) -> float:
    """Share of the accepted merges whose 99 % region has the truth in it."""
    accepted = results.column(f'{scene}_accepted') > 0.0
    inside = results.column(f'{scene}_{name}')[accepted] >= SIGNIFICANCE
    return float(np.mean(inside)) if len(inside) else float('nan')


def _jacobians(results: Results) -> Table:
    rows = []
    for said, own in zip(TABLE_I, results.values[0]['wide_sizes'], strict=True):
        points, full_rows, full_columns, rows_r, columns_r = own
        full = f'{full_rows} x {full_columns}'
        rows.append((said[0], str(points), said[1], full, said[2], f'{rows_r} x {columns_r}'))
    return Table(
        'Jacobians of one run of the wide scene (Table I)',
        (
            'map',
            '#points',
            '#full: paper',
            '#full: ours',
            '#compressed: paper',
            '#compressed: ours',
        ),
        tuple(rows),
    )


def _gaps(results: Results) -> list[Check]:
    checks = []
    for scene, gap in GAPS.items():
        rates = _rates(results, scene)
        lost = rates['full'] - rates['ours']
        checks.append(
            Check(
                f'{scene}: success of the full bundle less ours',
                f'≤ {100 * gap:g} points',
                f'{100 * lost:.1f} points',
                lost <= gap + 1e-12,
            )
        )
    return checks


def _wrong(results: Results) -> Check:
    wrong = _is_wrong(results, 'wide')
    believed = int(np.count_nonzero(wrong & (results.column('wide_accepted') > 0.0)))
    return Check(
        'wide: wrong merges that are accepted',
        '0',
        f'{believed} of {np.count_nonzero(wrong)} wrong',
        believed == 0,
    )


def _coverage(results: Results) -> list[Check]:
    checks = []
    for region, name in (
        ('99 % region of the merge (its cost)', 'p_cost'),
        ('ellipsoid of R̄ in the outgoing map', 'p_reported'),
    ):
        seen = _covered(results, 'narrow', name)
        text = f'narrow: truth within the {region}, of the accepted'
        checks.append(Check(text, f'≥ {COVERAGE:.0%}', f'{seen:.1%}', seen >= COVERAGE))
    return checks


def draw(results: Results) -> Figure:
    """Share of runs below an error, per scene."""
    figure = new_figure(columns=len(WIDTHS))
    share = np.arange(1, len(results.values) + 1) / results.ended
    for axes, (scene, width) in zip(figure.axes, WIDTHS.items(), strict=True):
        for name, text, _, colour in METHODS:
            errors: Floats = np.sort(results.column(f'{scene}_{name}'))
            style, order = ('--', 4) if name == 'full' else ('-', 3)
            axes.step(errors, share, style, where='post', color=colour, label=text, zorder=order)
        axes.axvline(SUCCESS, color='0.6', lw=0.8)
        axes.set_xscale('log')
        label(axes, 'RMSE [m]', 'share of runs', f'Corners spread over {width} m')
    return figure
