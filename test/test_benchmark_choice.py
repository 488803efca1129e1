# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the choice runs on a small fleet, and judges what it says it does."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('pycolmap', reason='drones bundle with Ceres: pip install pycolmap')

sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))

from landmark_choice import Placed, Robots, by_lot, compare, errors, merge, simulated_robots

from mapmerge_ros.geometry import Similarity
from mapmerge_ros.simulation import FleetConfig


@pytest.fixture(scope='module')
def robots() -> Robots:
    return simulated_robots('two drones', FleetConfig(drones=2, landmarks=500, keyframes=12), 1)


def test_the_lot_keeps_the_budget_and_draws_for_both(robots: Robots) -> None:
    chosen = by_lot(robots.bundles, 15, np.random.default_rng(0))
    assert [len(ids) for ids in chosen] == [15, 15]
    np.testing.assert_array_equal(*chosen)


def test_all_points_and_cameras_are_judged_in_any_frame(robots: Robots) -> None:
    found = merge(robots, by_lot(robots.bundles, 40, np.random.default_rng(0)))
    assert found is not None
    assert len(found.points) == sum(len(bundle.points) for bundle in robots.bundles)
    assert len(found.centres) == sum(len(bundle.keyframe_ids) for bundle in robots.bundles)
    right = Placed(np.concatenate(robots.points), np.concatenate(robots.centres))
    frame = Similarity.exp(np.arange(7) / 10.0)
    moved = Placed(frame.apply(found.points), frame.apply(found.centres))
    assert errors(found, right) == pytest.approx(errors(moved, right), rel=1e-6)
    assert 0.0 < errors(found, right)[0] < 0.2  # [m], over a yard of 30 m
    assert errors(right, right) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_the_table_has_a_line_for_each_reference(robots: Robots) -> None:
    lines = list(compare(robots, [20], draws=1))
    assert ['truth' in line for line in lines] == [True, False]
    assert all(line.count('|') == 9 for line in lines)
