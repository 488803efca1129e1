# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""5.A.2: maps whose bundle was stopped early lose nothing in the merge, thanks to c."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from mapmerge_ros.arrays import Floats, Ids
from mapmerge_ros.bundle import Bundle, compress
from mapmerge_ros.experiments.baselines import merged_points, procrustes_average, rmse_to
from mapmerge_ros.experiments.figures import (
    FULL,
    OURS,
    PAPER,
    PROCRUSTES,
    SINGLE,
    label,
    new_figure,
)
from mapmerge_ros.experiments.fleets import fleet_of, map_name
from mapmerge_ros.experiments.result import Check, Experiment, Results, Summary, Table, Values
from mapmerge_ros.experiments.stopping import descend, disturbed, gradient_norm, noisy
from mapmerge_ros.fusion import fuse
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.simulation import (
    Session,
    box_scene,
    box_truth,
    joint_bundle,
    random_frame,
    solve,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIGMA, SEEN_RATIO = 0.005, 0.8

SHARED = 30
"""Landmarks that are merged and measured; Procrustes registers by all 100."""

START_ERROR_RAD = 0.02
"""Nine times the error of a converged map."""

TOLERANCES = (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 1e-4, 1e-5)
"""Largest entry of the gradient at which a bundle is stopped."""

MAX_LOSS, NEAR, TIE = 1.02, 3.0, 1.001

CURVES = ('single', 'procrustes', 'paper', 'ours')


def run_one(seed: int, run: int) -> Values:
    """Three bundles stopped at every level, merged in four ways; RMSE in metres."""
    rng = np.random.default_rng([seed, run])
    truth = box_truth(rng, seen_ratio=SEEN_RATIO)
    frames = [random_frame(rng, each.gauge) for each in truth]
    optima = [solve(noisy(each, rng, SIGMA)).bundle for each in truth]
    bundles = [disturbed(optimum, rng, START_ERROR_RAD) for optimum in optima]
    ids = truth[0].point_ids[:SHARED]
    levels = []
    for tolerance in TOLERANCES:
        bundles = [descend(bundle, tolerance) for bundle in bundles]
        levels.append(_level(truth[0], bundles, frames, ids))
    return {
        'full': rmse_to(truth[0].points[:SHARED], _full(truth, optima, ids)),
        'converged': _single(truth[0], optima, ids),
        **{name: [level[name] for level in levels] for name in ('gradient', *CURVES)},
    }


def _level(
    truth: Bundle, bundles: Sequence[Bundle], frames: Sequence[Similarity], ids: Ids
) -> dict[str, float]:
    submaps = [
        compress(bundle.transformed(frame), map_name(k), ids, catalogue=False)
        for k, (bundle, frame) in enumerate(zip(bundles, frames, strict=True))
    ]
    stationary = [replace(submap, c=np.zeros_like(submap.c)) for submap in submaps]
    every, registered = procrustes_average(
        [bundle.point_ids for bundle in bundles], [bundle.points for bundle in bundles]
    )
    merged = {
        'procrustes': registered[np.searchsorted(every, ids)],
        'paper': merged_points(fuse(stationary), ids),
        'ours': merged_points(fuse(submaps), ids),
    }
    points = truth.points[truth.rows_of(ids)]
    return {
        'gradient': float(np.mean([gradient_norm(bundle) for bundle in bundles])),
        'single': _single(truth, bundles, ids),
        **{name: rmse_to(points, found) for name, found in merged.items()},
    }


def _single(truth: Bundle, bundles: Sequence[Bundle], ids: Ids) -> float:
    """Mean RMSE of the maps, each registered to the truth by itself."""
    points = truth.points[truth.rows_of(ids)]
    return float(np.mean([rmse_to(points, b.points[b.rows_of(ids)]) for b in bundles]))


def _full(truth: Sequence[Bundle], optima: Sequence[Bundle], ids: Ids) -> Floats:
    sessions = [
        Session(optimum, each, Similarity.identity(), each.point_ids)
        for optimum, each in zip(optima, truth, strict=True)
    ]
    # Of the scene only the ids matter here.
    scene = box_scene(np.random.default_rng(0), len(truth[0].points))
    full = solve(joint_bundle(fleet_of(scene, sessions))).bundle
    return full.points[full.rows_of(ids)]


def summarise(results: Results) -> Summary:
    """Mean curves over the gradient norm, against the full bundle."""
    curves = {name: results.column(name).mean(axis=0) for name in ('gradient', *CURVES)}
    full, converged = results.column('full').mean(), results.column('converged').mean()
    rows = tuple(
        (
            f'{curves["gradient"][k]:.1e}',
            *(f'{curves[name][k]:.4f}' for name in CURVES),
            f'{full:.4f}',
            f'{curves["ours"][k] / full:.3f}',
        )
        for k in range(len(TOLERANCES))
    )
    table = Table(
        'Mean RMSE [m] of bundles stopped early',
        (
            '#gradient norm',
            '#single maps',
            '#Procrustes',
            '#paper (c = 0)',
            '#ours (c)',
            '#full bundle',
            '#ours / full',
        ),
        rows,
    )
    near = curves['single'] <= NEAR * converged
    loss = float(np.max(curves['ours'][near] / full, initial=0.0))
    decades = float(np.log10(curves['gradient'].max() / curves['gradient'].min()))
    checks = (
        Check(
            f'ours / full bundle where single maps are within {NEAR:g} × converged',
            f'≤ {MAX_LOSS}',
            f'{loss:.4f}',
            loss <= MAX_LOSS and bool(near.any()),
        ),
        *(
            _never_above(curves, name, text)
            for name, text in (('paper', "the paper's form"), ('procrustes', 'Procrustes'))
        ),
        Check('decades of the gradient norm', '≥ 4', f'{decades:.1f}', decades >= 4.0),
    )
    return Summary(
        (table,),
        checks,
        (
            f'{SHARED} of 100 landmarks are merged and measured, after Procrustes to the truth; '
            f'the converged maps by themselves have {converged:.4f}.',
        ),
    )


def _never_above(curves: dict[str, Floats], name: str, text: str) -> Check:
    worst = float(np.max(curves['ours'] / curves[name]))
    # At the optimum both are the same map; which one comes out ahead there is rounding.
    return Check(f'ours / {text}, at any gradient norm', f'≤ {TIE}', f'{worst:.4f}', worst <= TIE)


def draw(results: Results) -> Figure:
    """Mean RMSE over the gradient norm."""
    figure = new_figure()
    axes = figure.axes[0]
    gradient = results.column('gradient').mean(axis=0)
    for name, text, colour in (
        ('single', 'single maps', SINGLE),
        ('procrustes', 'Procrustes + averaging', PROCRUSTES),
        ('paper', "the paper's form (c = 0)", PAPER),
        ('ours', 'ours (with c)', OURS),
    ):
        axes.plot(gradient, results.column(name).mean(axis=0), 'o-', color=colour, label=text)
    axes.axhline(float(results.column('full').mean()), ls='--', color=FULL, label='full bundle')
    axes.set_xscale('log')
    axes.set_yscale('log')
    label(
        axes,
        'mean gradient norm ‖2 rᵀJ‖ of the single maps',
        'mean RMSE [m]',
        f'Bundles stopped early, {len(results.values)} runs',
    )
    return figure


EXPERIMENT = Experiment(
    name='early-stop',
    title='Bundles that were stopped early (5.A.2)',
    runs=1000,
    run_one=run_one,
    summarise=summarise,
    draw=draw,
)
