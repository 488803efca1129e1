# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Real sub-maps against the full bundle of all their images, as the project promises."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('pycolmap', reason='COLMAP models are read by pycolmap')

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / 'shared' / 'data'
sys.path.insert(0, str(ROOT / 'benchmarks'))
import real_data  # noqa: E402
from honest_tests import draw, load  # noqa: E402

from mapmerge_ros.fusion import fuse  # noqa: E402
from mapmerge_ros.geometry import Gauge, align_robustly  # noqa: E402


def evaluate(name, cap=None):
    if not (DATA / name).is_dir():
        pytest.skip(f'{DATA / name} is not there: real data is not shipped')
    return real_data.evaluate(DATA / name, cap)


@pytest.mark.parametrize(
    ('name', 'maps', 'limit', 'procrustes'),
    [
        ('euroc_v101_maplab', 8, 7e-4, 5e-3),
        ('brighton_drone', 2, 2.5e-4, 1e-3),
        ('bal_ladybug49', 3, 1e-3, 5e-3),
    ],
)
def test_the_merge_is_close_to_the_full_bundle(name, maps, limit, procrustes):
    row, fusion = evaluate(name)
    assert row.merged == row.sessions == maps
    assert row.merge <= limit
    assert row.procrustes >= procrustes  # the baseline is no straw man of ours: README of the data
    assert fusion.components[0].converged


def test_ids_that_two_robots_gave_away_by_themselves_are_not_believed():
    """Three private ids of EuRoC stand for different points in two sessions."""
    _, fusion = evaluate('euroc_v101_maplab')
    assert {item.landmark_id for item in fusion.contradictions} == {
        100000160,
        100000466,
        100000480,
    }


@pytest.mark.parametrize('name', ['brighton_drone', 'bal_ladybug49'])
def test_no_true_landmark_is_called_a_contradiction(name):
    _, fusion = evaluate(name)
    assert fusion.contradictions == ()


@pytest.mark.parametrize('name', ['caliterra_drone', 'euroc_v101_maplab'])
def test_two_halves_of_a_fleet_differ_by_what_their_std_say(name):
    """Of other images: by noise and, on Caliterra three times as much, by the warp of lenses."""
    if not (DATA / name).is_dir():
        pytest.skip(f'{DATA / name} is not there: real data is not shipped')
    submaps = draw(*load(DATA / name, all_tracks=True), 0)
    half = len(submaps) // 2
    one, other = (fuse(own).components[0].landmarks for own in (submaps[:half], submaps[half:]))
    _, a, b = np.intersect1d(one.ids, other.ids, return_indices=True)
    there, here = one.points_global[a], other.points_global[b]
    S_one_other = align_robustly(
        there, here, gauge=Gauge.SIMILARITY, weights=np.ones(len(a))
    ).S_target_source
    variances = np.einsum('ij,nj->ni', S_one_other.rotation**2, other.std[b] ** 2)
    std = np.sqrt(one.std[a] ** 2 + S_one_other.scale**2 * variances)
    standardised = np.abs(there - S_one_other.apply(here)) / std
    sizes = np.median(standardised, axis=0) / 0.6745
    assert len(a) > 30
    assert (sizes < 1.6).all()
    assert (sizes > 0.4).all()
