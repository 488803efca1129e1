# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""5.A.1: the price of merging follows the Γ distribution that the test relies on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from mapmerge_ros.bundle import Bundle, MapName, compress
from mapmerge_ros.experiments.figures import NEUTRAL, OURS, PAPER, label, new_figure
from mapmerge_ros.experiments.result import Check, Experiment, Results, Summary, Table, Values
from mapmerge_ros.fusion import fuse
from mapmerge_ros.simulation import box_truth, measured
from mapmerge_ros.submap import SubMap

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIGMA, SHARED = 0.05, 10
DOF = 3 * SHARED * 2 - 7 * 2
"""Ten landmarks common to three maps, two frames removed (eq. 13): 46."""

MIN_KS, MEAN_TOLERANCE = 0.01, 0.02


def run_one(seed: int, run: int) -> Values:
    """One noise realisation; cameras and points are those of the seed."""
    truth = box_truth(np.random.default_rng(seed))
    bundles = measured(truth, np.random.default_rng([seed, run]), SIGMA)
    submaps = compressed(bundles, SHARED)
    known = fuse(submaps).verdict
    estimated = fuse(replace(submap, sigma=0.0) for submap in submaps).verdict
    return {
        'a_tilde': known.a_tilde / SIGMA**2,
        'dof': known.dof,
        'p_known': known.p_value,
        'p_estimated': estimated.p_value,
    }


def compressed(bundles: Sequence[Bundle], shared: int) -> list[SubMap]:
    """Sub-maps of the first `shared` landmarks of each bundle, without catalogue."""
    return [
        compress(
            bundle,
            MapName(f'map{k}', f'robot{k}', id_space='box'),
            bundle.point_ids[:shared],
            catalogue=False,
        )
        for k, bundle in enumerate(bundles)
    ]


def summarise(results: Results) -> Summary:
    """Compare with χ²(46); p-values with the uniform distribution."""
    prices = results.column('a_tilde')
    mean, std = float(np.mean(prices)), float(np.std(prices))
    ks_price = float(scipy.stats.kstest(prices, scipy.stats.chi2(DOF).cdf).pvalue)
    p_values = results.column('p_estimated')
    ks_estimated = float(scipy.stats.kstest(p_values, scipy.stats.uniform.cdf).pvalue)
    refused = [np.mean(results.column(name) < 0.01) for name in ('p_known', 'p_estimated')]
    rows = (
        ('mean of ã/σ²', f'{mean:.2f}', f'{DOF}'),
        ('standard deviation of ã/σ²', f'{std:.2f}', f'{np.sqrt(2 * DOF):.2f}'),
        (
            '99th percentile',
            f'{np.quantile(prices, 0.99):.1f}',
            f'{scipy.stats.chi2.ppf(0.99, DOF):.1f}',
        ),
        ('refused at 1 %, σ known', f'{refused[0]:.2%}', '1 %'),
        ('refused at 1 %, σ estimated', f'{refused[1]:.2%}', '1 %'),
    )
    checks = (
        Check(
            'ã/σ² is distributed as Γ(23, 2)',
            f'KS p ≥ {MIN_KS}',
            f'{ks_price:.2g}',
            ks_price >= MIN_KS,
        ),
        Check(
            'mean of ã/σ²',
            f'{DOF} ± {MEAN_TOLERANCE:.0%}',
            f'{mean:.2f}',
            abs(mean / DOF - 1.0) <= MEAN_TOLERANCE,
        ),
        Check(
            'F test is calibrated when σ is estimated',
            f'KS p ≥ {MIN_KS}',
            f'{ks_estimated:.2g}',
            ks_estimated >= MIN_KS,
        ),
    )
    return Summary((Table('Price of merging', ('', '#ours', '#expected'), rows),), checks)


def draw(results: Results) -> Figure:
    """Histogram of ã with its density; p-values of the F test."""
    figure = new_figure(columns=2)
    price, uniform = figure.axes
    at = np.linspace(15.0, 90.0, 300)
    bins = np.linspace(15.0, 90.0, 41)
    price.hist(
        results.column('a_tilde'),
        bins=bins.tolist(),
        density=True,
        color=NEUTRAL,
        label=f'{len(results.values)} merges',
    )
    price.plot(at, scipy.stats.chi2.pdf(at, DOF), color=PAPER, label=f'Γ({DOF // 2}, 2)')
    label(price, 'ã / σ²', 'density', 'Price of merging three maps')
    bins = np.linspace(0.0, 1.0, 21)
    uniform.hist(results.column('p_estimated'), bins=bins.tolist(), density=True, color=NEUTRAL)
    uniform.axhline(1.0, color=OURS, label='uniform')
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
