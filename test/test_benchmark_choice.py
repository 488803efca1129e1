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

from dataclasses import replace

from choice_errors import COLUMNS, SPREAD, Placed, errors, merge
from choice_robots import Robots, simulated_robots
from landmark_choice import FRAMES, HEAD, by_lot, compare, pooled, rows

from mapmerge_ros.geometry import Similarity
from mapmerge_ros.simulation import FleetConfig


@pytest.fixture(scope='module')
def robots() -> Robots:
    return simulated_robots('two drones', FleetConfig(drones=2, landmarks=500, keyframes=12), 1)


def test_the_lot_keeps_the_budget_and_draws_for_both(robots: Robots) -> None:
    chosen = by_lot(robots.bundles, 15, np.random.default_rng(0))
    assert [len(ids) for ids in chosen] == [15, 15]
    np.testing.assert_array_equal(*chosen)


def moved(placed: Placed, frame: Similarity) -> Placed:
    return Placed(
        frame.apply(placed.landmarks),
        tuple(frame @ S_common_map for S_common_map in placed.frames),
        frame.apply(placed.points),
        frame.apply(placed.centres),
    )


def test_everything_is_judged_in_any_frame(robots: Robots) -> None:
    chosen = by_lot(robots.bundles, 40, np.random.default_rng(0))
    both = merge(robots, chosen)
    assert both is not None
    found, right = both
    assert len(found.landmarks) == len(right.landmarks) == len(chosen[0])
    assert len(found.points) == sum(len(bundle.points) for bundle in robots.bundles)
    assert len(found.centres) == sum(len(bundle.keyframe_ids) for bundle in robots.bundles)
    elsewhere = moved(found, Similarity.exp(np.arange(7) / 10.0))
    ours = errors(robots, found, right)
    assert errors(robots, elsewhere, right) == pytest.approx(ours, rel=1e-6)
    assert (ours > 0.0).all()
    assert ours[0] < 0.2  # [m], over a yard of 30 m
    best = errors(robots, right, right)
    assert best[SPREAD] == pytest.approx(ours[SPREAD])
    assert np.delete(best, SPREAD) == pytest.approx(np.zeros(len(COLUMNS) - 1), abs=1e-9)


def test_the_error_of_frames_is_that_of_the_frames_alone(robots: Robots) -> None:
    """A frame that is off by half a metre is seen; points that are wrong are not."""
    both = merge(robots, by_lot(robots.bundles, 40, np.random.default_rng(0)))
    assert both is not None
    _, right = both
    shift = Similarity(1.0, np.eye(3), np.array([0.5, 0.0, 0.0]))
    off = replace(right, frames=(right.frames[0], shift @ right.frames[1]))
    assert 0.1 < errors(robots, off, right)[FRAMES] < 0.5
    wrong = replace(right, points=right.points + 1.0, landmarks=right.landmarks[::-1].copy())
    assert errors(robots, wrong, right)[FRAMES] == pytest.approx(0.0, abs=1e-9)


def test_the_table_has_a_line_for_each_budget_and_the_bound(robots: Robots) -> None:
    (compared,) = compare(robots, [20], draws=1)
    assert compared.joined == 1
    ratios, bound = pooled([compared, compared])
    assert ratios == pytest.approx(compared.chosen / compared.lot)
    assert bound == pytest.approx(compared.everything[FRAMES] / compared.lot[FRAMES])
    lines = list(rows(iter([('two drones', [robots])]), draws=1))
    assert [line.count('|') for line in lines] == [HEAD[0].count('|')] * 3
