# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Real sub-maps against the full bundle of all their images, as the project promises."""

import sys
from pathlib import Path

import pytest

pytest.importorskip('pycolmap', reason='COLMAP models are read by pycolmap')

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / 'shared' / 'data'
sys.path.insert(0, str(ROOT / 'benchmarks'))
import real_data  # noqa: E402


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
