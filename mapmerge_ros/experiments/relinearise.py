# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Ours: rounds of merging and linearising again, against the full bundle of all images."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mapmerge_ros.experiments.figures import OURS, PAPER, SINGLE, label, new_figure
from mapmerge_ros.experiments.result import Check, Experiment, Results, Summary, Table, Values
from mapmerge_ros.experiments.room import SIGMA, WIDTHS, simulate_room
from mapmerge_ros.fusion.refine import Robot, refine
from mapmerge_ros.simulation import Fleet, joint_bundle, solve

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROUNDS = 4
"""One more than the claim is about: the last one shows the floor of rounding."""

WITHIN, TOLERANCE, SHARE = 3, 1e-8, 0.99


def run_one(seed: int, run: int) -> Values:
    """Relative difference of the true cost to that of the full bundle after each round."""
    fleet = simulate_room(np.random.default_rng([seed, run]), WIDTHS['wide'])
    _, rounds = refine(robots_of(fleet), ROUNDS)
    full = solve(joint_bundle(fleet)).cost_px2
    costs = [each.cost_px2 * SIGMA**2 for each in rounds]
    costs += [costs[-1]] * (ROUNDS - len(costs))
    return {
        'accepted': rounds[0].fusion.verdict.accepted,
        'differences': [cost / full - 1.0 for cost in costs],
        'shares': [each.share for each in rounds],
    }


def robots_of(fleet: Fleet) -> list[Robot]:
    """Robots of a fleet with the landmarks that they share."""
    return [
        Robot(name, bundle, bundle.point_ids[fleet.shared_rows(k)])
        for k, (bundle, name) in enumerate(zip(fleet.bundles, fleet.names, strict=True))
    ]


def summarise(results: Results) -> Summary:
    """Share of the accepted merges that reach the full bundle in time."""
    accepted = results.column('accepted').astype(bool)
    differences = results.column('differences')[accepted]
    reached = np.abs(differences[:, WITHIN - 1]) < TOLERANCE if len(differences) else np.zeros(0)
    share = float(np.mean(reached)) if len(reached) else 0.0
    rows = tuple(
        (
            str(number + 1),
            *(
                f'{value:.1e}'
                for value in np.quantile(np.abs(differences[:, number]), (0.5, 0.99, 1.0))
            ),
        )
        for number in range(ROUNDS if len(differences) else 0)
    )
    check = Check(
        f'true cost within {TOLERANCE:g} of the full bundle after {WITHIN} rounds, '
        'of the accepted merges',
        f'at least {SHARE:.0%}',
        f'{share:.1%} of {len(reached)}',
        share >= SHARE,
    )
    table = Table(
        'Relative difference of the true cost to that of the full bundle',
        ('#round', '#median', '#99 %', '#largest'),
        rows,
    )
    return Summary((table,), (check,))


def draw(results: Results) -> Figure:
    """Median and spread of the runs."""
    figure = new_figure()
    axes, numbers = figure.axes[0], np.arange(1, ROUNDS + 1)
    differences = np.maximum(np.abs(results.column('differences')), 1e-16)
    low, high = np.quantile(differences, (0.01, 0.99), axis=0)
    axes.fill_between(numbers, low, high, color=SINGLE, alpha=0.3, label='98 % of the runs')
    axes.semilogy(numbers, np.median(differences, axis=0), color=OURS, lw=2, label='median')
    axes.axhline(TOLERANCE, color=PAPER, ls=':', label=f'{TOLERANCE:g}')
    axes.set_xticks(numbers.tolist())
    label(axes, 'round', 'relative difference of the true cost', 'Distance to the full bundle')
    return figure


EXPERIMENT = Experiment(
    name='relinearise',
    title='Rounds of re-linearisation against the full bundle',
    runs=200,
    run_one=run_one,
    summarise=summarise,
    draw=draw,
)
