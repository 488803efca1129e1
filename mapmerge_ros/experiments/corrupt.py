# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""'Using merging for increased robustness': the corrupt part of a session, found and left out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mapmerge_ros.arrays import Floats, Ids, Ints
from mapmerge_ros.bundle import Bundle, MapName, compress, linearise
from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.experiments.baselines import merged_points, rmse_to
from mapmerge_ros.experiments.consensus import Consensus, Part, find_corrupt
from mapmerge_ros.experiments.corrupt_session import (
    CORRUPT_KEYFRAMES,
    CORRUPT_LANDMARKS,
    KEYFRAMES,
    SENSING,
    SHIFT,
    damaged_session,
)
from mapmerge_ros.experiments.figures import FULL, NEUTRAL, OURS, PAPER, label, new_figure
from mapmerge_ros.experiments.result import (
    Check,
    Experiment,
    ExperimentError,
    Results,
    Summary,
    Table,
    Values,
)
from mapmerge_ros.experiments.split import part_of, shared_ids, stretches
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.simulation import adjust

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARTS, MIN_KEYFRAMES = 8, 3

CONFIG = FusionConfig(significance=1e-4, unlock=False)
"""Some twenty tests a run, and none may refuse a good part."""

MIN_NAMED, MAX_RMSE_RATIO = 0.99, 1.05


def run_one(seed: int, run: int) -> Values:
    """One session with a corrupt stretch: what is named, and how good is what remains."""
    session = damaged_session(np.random.default_rng([seed, run]))
    bundle, truth, corrupt_rows = session.bundle, session.truth, session.damage.keyframe_rows
    found = find_in(bundle)
    if not found.fusion.components:
        raise ExperimentError('corrupt: no part was kept')
    reference = adjust(part_of(bundle, np.setdiff1d(np.arange(KEYFRAMES), corrupt_rows)))
    ids = np.intersect1d(found.fusion.components[0].landmarks.ids, reference.point_ids)
    points_world = truth.points[truth.rows_of(ids)]
    return {
        'factor': linearise(bundle).cost_px2
        / (SENSING.sigma_px**2 * (bundle.residual_count - bundle.dof)),
        'corrupt': corrupt_rows,
        'refused': [part.keyframe_rows.tolist() for part in found.refused],
        'lost': len(np.setdiff1d(found.refused_rows, corrupt_rows)),
        'named': is_named(found, corrupt_rows),
        'rmse_merged': rmse_to(points_world, merged_points(found.fusion, ids)),
        'rmse_reference': rmse_to(points_world, reference.points[reference.rows_of(ids)]),
        'rmse_corrupt': rmse_to(points_world, bundle.points[bundle.rows_of(ids)]),
        'landmarks': len(ids),
        'merges': found.merges,
    }


def find_in(bundle: Bundle) -> Consensus:
    """Divide a session, bundle its parts, and find those that do not agree with the others."""
    runs = stretches(np.arange(len(bundle.keyframe_ids)), PARTS)
    shared = shared_ids([part_of(bundle, rows) for rows in runs])

    def split(part: Part) -> Sequence[Part]:
        if len(part.keyframe_rows) < 2 * MIN_KEYFRAMES:
            return ()
        return [bundled(bundle, rows, shared) for rows in stretches(part.keyframe_rows, 2)]

    return find_corrupt([bundled(bundle, rows, shared) for rows in runs], split, CONFIG)


def bundled(bundle: Bundle, keyframe_rows: Ints, shared: Ids) -> Part:
    """Adjust a stretch by itself and compress it to the shared landmarks that it has."""
    name = MapName(f'part{keyframe_rows[0]:04d}-{keyframe_rows[-1]:04d}', 'robot', id_space='s')
    try:
        own = adjust(part_of(bundle, keyframe_rows))
        ids = np.intersect1d(shared, own.point_ids)
        return Part(keyframe_rows, compress(own, name, ids, catalogue=False))
    except MapMergeError:
        return Part(keyframe_rows, None)


def is_named(found: Consensus, corrupt_rows: Ints) -> bool:
    """Every corrupt key frame is in a refused part, and every refused part has one."""
    inside = np.isin(corrupt_rows, found.refused_rows).all()
    return bool(
        inside and all(np.isin(part.keyframe_rows, corrupt_rows).any() for part in found.refused)
    )


def summarise(results: Results) -> Summary:
    """How often the corrupt part is named, and what the rest is worth."""
    named = results.share(results.column('named') > 0)
    merged, reference, corrupt = (
        results.column(f'rmse_{name}') for name in ('merged', 'reference', 'corrupt')
    )
    ratio = _rms(merged) / _rms(reference)
    each = merged / reference
    rows = (
        (
            'bundle with the corrupt part',
            f'{1e3 * _rms(corrupt):.1f}',
            f'{1e3 * np.median(corrupt):.1f}',
        ),
        ('bundle without it', f'{1e3 * _rms(reference):.2f}', f'{1e3 * np.median(reference):.2f}'),
        (
            'merged parts that are kept',
            f'{1e3 * _rms(merged):.2f}',
            f'{1e3 * np.median(merged):.2f}',
        ),
    )
    checks = (
        Check(
            'the corrupt part is named',
            f'≥ {MIN_NAMED:.0%} of runs',
            f'{named:.1%}',
            named >= MIN_NAMED,
        ),
        Check(
            'RMSE against the bundle without it',
            f'≤ {MAX_RMSE_RATIO:.2f} times',
            f'{ratio:.3f}',
            ratio <= MAX_RMSE_RATIO,
        ),
    )
    notes = (
        '{} to {} of {} key frames are corrupt: '.format(*CORRUPT_KEYFRAMES, KEYFRAMES)
        + f'{CORRUPT_LANDMARKS} landmarks displaced by {SHIFT} m; the whole bundle costs '
        f'{np.median(results.column("factor")):.1f} times what noise explains (median)',
        f'good key frames lost with the corrupt ones: {results.column("lost").mean():.1f} a run',
        f'tests a run: {results.column("merges").mean():.1f}',
        f'RMSE ratio of single runs: median {np.median(each):.3f}, 90 % below '
        f'{np.quantile(each, 0.9):.3f}, largest {each.max():.3f}; '
        f'{results.share(each <= MAX_RMSE_RATIO):.0%} of the runs within 5 %',
    )
    columns = ('map', '#RMSE [mm]', '#median')
    return Summary((Table('What remains', columns, rows),), checks, notes)


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def draw(results: Results) -> Figure:
    """Which key frames were refused in the first runs; RMSE against the reference."""
    figure = new_figure(columns=2)
    stretch, error = figure.axes
    for at, values in enumerate(results.values[:30]):
        for rows in values['refused']:
            stretch.barh(at, len(rows), left=rows[0] - 0.5, height=0.9, color=NEUTRAL)
        corrupt = values['corrupt']
        stretch.barh(at, len(corrupt), left=corrupt[0] - 0.5, height=0.35, color=PAPER)
    stretch.barh(0, 0, color=NEUTRAL, label='refused')
    stretch.barh(0, 0, color=PAPER, label='corrupt')
    stretch.set_xlim(-0.5, KEYFRAMES - 0.5)
    label(stretch, 'key frame', 'run', 'Named parts')
    reference = 1e3 * results.column('rmse_reference')
    error.loglog(
        reference,
        1e3 * results.column('rmse_corrupt'),
        '.',
        color=FULL,
        label='bundle with the corrupt part',
    )
    error.loglog(
        reference,
        1e3 * results.column('rmse_merged'),
        '.',
        color=OURS,
        label='merged parts that are kept',
    )
    ends = [float(reference.min()), float(reference.max())]
    error.plot(ends, ends, color=NEUTRAL)
    error.set_ylim(top=2e3 * float(results.column('rmse_corrupt').max()))
    label(error, 'RMSE of the bundle without it [mm]', 'RMSE [mm]', 'What remains')
    return figure


EXPERIMENT = Experiment(
    name='corrupt',
    title='A corrupt part found by merging (increased robustness)',
    runs=200,
    run_one=run_one,
    summarise=summarise,
    draw=draw,
)
