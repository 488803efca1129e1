# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
5.A.1: the price of merging follows the Γ distribution that the test relies on.

Twice: from the maps as they are bundled (the paper), and from their next revision, after the
robots have taken the merged landmarks over and linearised there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from mapmerge_ros.bundle import Bundle, MapName, compress
from mapmerge_ros.experiments.figures import NEUTRAL, OURS, PAPER, label, new_figure
from mapmerge_ros.experiments.result import Check, Experiment, Results, Summary, Table, Values
from mapmerge_ros.experiments.whole_map import WHOLE_MAP
from mapmerge_ros.fusion import fuse
from mapmerge_ros.fusion.refine import Robot, refine
from mapmerge_ros.simulation import box_truth, measured
from mapmerge_ros.submap import SubMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIGMA, SHARED = 0.05, 10
DOF = 3 * SHARED * 2 - 7 * 2
"""Ten landmarks common to three maps, two frames removed (eq. 13): 46."""

MIN_KS, MEAN_TOLERANCE = 0.01, 0.02

FORMS = {'once': 'linearised once', 'again': 'linearised again'}
"""At each map's own optimum, as in the paper; at the landmarks of the first merge."""


def run_one(seed: int, run: int) -> Values:
    """One noise realisation; cameras and points are those of the seed."""
    truth = box_truth(np.random.default_rng(seed))
    bundles = measured(truth, np.random.default_rng([seed, run]), SIGMA)
    robots = [
        Robot(_name(k), bundle, bundle.point_ids[:SHARED]) for k, bundle in enumerate(bundles)
    ]
    moved, _ = refine(robots, 1)
    return {
        f'{form}_{name}': value
        for form, fleet in zip(FORMS, (robots, moved), strict=True)
        for name, value in _prices([robot.bundle for robot in fleet]).items()
    }


def _prices(bundles: Sequence[Bundle]) -> Values:
    submaps = compressed(bundles, SHARED)
    known = fuse(submaps, WHOLE_MAP).verdict
    estimated = fuse([replace(submap, sigma=0.0) for submap in submaps], WHOLE_MAP).verdict
    return {
        'a_tilde': known.a_tilde / SIGMA**2,
        'p_known': known.p_value,
        'p_estimated': estimated.p_value,
    }


def compressed(bundles: Sequence[Bundle], shared: int) -> list[SubMap]:
    """Sub-maps of the first `shared` landmarks of each bundle, without catalogue."""
    return [
        compress(bundle, _name(k), bundle.point_ids[:shared], catalogue=False)
        for k, bundle in enumerate(bundles)
    ]


def _name(k: int) -> MapName:
    return MapName(f'map{k}', f'robot{k}', id_space='box')


def summarise(results: Results) -> Summary:
    """Compare with χ²(46); p-values with the uniform distribution."""
    columns = [_figures(results, form) for form in FORMS]
    expected = (
        f'{DOF}',
        f'{np.sqrt(2 * DOF):.2f}',
        f'{scipy.stats.chi2.ppf(0.99, DOF):.1f}',
        '1 %',
        '1 %',
    )
    rows = tuple(
        (text, *(own[text] for own in columns), said)
        for text, said in zip(columns[0], expected, strict=True)
    )
    names = tuple(f'#{text}' for text in FORMS.values())
    return Summary(
        (Table('Price of merging', ('', *names, '#expected'), rows),),
        tuple(check for form in FORMS for check in _checks(results, form)),
    )


def _figures(results: Results, form: str) -> dict[str, str]:
    prices = results.column(f'{form}_a_tilde')
    refused = [
        np.mean(results.column(f'{form}_{name}') < 0.01) for name in ('p_known', 'p_estimated')
    ]
    return {
        'mean of ã/σ²': f'{np.mean(prices):.2f}',
        'standard deviation of ã/σ²': f'{np.std(prices):.2f}',
        '99th percentile': f'{np.quantile(prices, 0.99):.1f}',
        'refused at 1 %, σ known': f'{refused[0]:.2%}',
        'refused at 1 %, σ estimated': f'{refused[1]:.2%}',
    }


def _checks(results: Results, form: str) -> list[Check]:
    prices, p_values = (results.column(f'{form}_{name}') for name in ('a_tilde', 'p_estimated'))
    ks_price = float(scipy.stats.kstest(prices, scipy.stats.chi2(DOF).cdf).pvalue)
    ks_estimated = float(scipy.stats.kstest(p_values, scipy.stats.uniform.cdf).pvalue)
    mean, text = float(np.mean(prices)), FORMS[form]
    return [
        Check(
            f'{text}: ã/σ² is distributed as Γ(23, 2)',
            f'KS p ≥ {MIN_KS}',
            f'{ks_price:.2g}',
            ks_price >= MIN_KS,
        ),
        Check(
            f'{text}: mean of ã/σ²',
            f'{DOF} ± {MEAN_TOLERANCE:.0%}',
            f'{mean:.2f}',
            abs(mean / DOF - 1.0) <= MEAN_TOLERANCE,
        ),
        Check(
            f'{text}: F test is calibrated when σ is estimated',
            f'KS p ≥ {MIN_KS}',
            f'{ks_estimated:.2g}',
            ks_estimated >= MIN_KS,
        ),
    ]


def draw(results: Results) -> Figure:
    """Histogram of ã with its density; p-values of the F test."""
    figure = new_figure(columns=2)
    price, uniform = figure.axes
    at = np.linspace(15.0, 90.0, 300)
    bins = np.linspace(15.0, 90.0, 41)
    price.hist(
        results.column('once_a_tilde'),
        bins=bins.tolist(),
        density=True,
        color=NEUTRAL,
        label=f'{FORMS["once"]}, {len(results.values)} merges',
    )
    price.hist(
        results.column('again_a_tilde'),
        bins=bins.tolist(),
        density=True,
        color=OURS,
        histtype='step',
        label=FORMS['again'],
    )
    price.plot(at, scipy.stats.chi2.pdf(at, DOF), color=PAPER, label=f'Γ({DOF // 2}, 2)')
    label(price, 'ã / σ²', 'density', 'Price of merging three maps')
    bins = np.linspace(0.0, 1.0, 21)
    uniform.hist(
        results.column('once_p_estimated'),
        bins=bins.tolist(),
        density=True,
        color=NEUTRAL,
        label=FORMS['once'],
    )
    uniform.hist(
        results.column('again_p_estimated'),
        bins=bins.tolist(),
        density=True,
        color=OURS,
        histtype='step',
        label=FORMS['again'],
    )
    uniform.axhline(1.0, color=PAPER, label='uniform')
    label(uniform, 'p-value', 'density', 'σ estimated: F test')
    return figure


EXPERIMENT = Experiment(
    name='gamma',
    title='Price of merging and its Γ distribution (5.A.1)',
    runs=2000,
    run_one=run_one,
    summarise=summarise,
    draw=draw,
)
