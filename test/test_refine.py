# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Rounds of re-linearisation reach the full bundle, and never make the true cost worse."""

from dataclasses import replace

import numpy as np
import pytest

from mapmerge_ros.bundle import MapName, compress, linearise
from mapmerge_ros.bundle.relinearise import relinearise
from mapmerge_ros.cli.main import main
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import FusionConfig, fuse
from mapmerge_ros.fusion.refine import Robot, refine
from mapmerge_ros.geometry import Gauge, align

pytest.importorskip('pycolmap', reason='full bundles are made by Ceres')

import itertools

from test_real_data import DATA

from mapmerge_ros.simulation import (
    FleetConfig,
    Sensing,
    joint_bundle,
    simulate_fleet,
    solve,
)


def robots_of(fleet):
    return [
        Robot(name, bundle, bundle.point_ids[fleet.shared_rows(k)])
        for k, (bundle, name) in enumerate(zip(fleet.bundles, fleet.names, strict=True))
    ]


def test_three_rounds_reach_the_full_bundle():
    fleet = simulate_fleet(FleetConfig(), 3)
    full = solve(joint_bundle(fleet))
    _, rounds = refine(robots_of(fleet), 4)
    costs = [each.cost_px2 * 0.5**2 for each in rounds]  # in units of sigma
    assert abs(costs[2] / full.cost_px2 - 1.0) < 1e-8
    assert all(after <= before for before, after in itertools.pairwise(costs))
    landmarks = rounds[-1].fusion.components[0].landmarks
    gold = full.bundle.points[full.bundle.rows_of(landmarks.ids)]
    moved = align(gold, landmarks.points_global).S_target_source.apply(landmarks.points_global)
    assert np.abs(moved - gold).max() < 1e-3 * np.median(landmarks.std)


def test_ids_that_contradict_are_told_after_every_round():
    """They are not compressed again: later rounds by themselves would know nothing of them."""
    fleet = simulate_fleet(FleetConfig(), 3)
    robots = robots_of(fleet)
    wrong = robots[1]
    ids = wrong.bundle.point_ids.copy()
    rows = np.flatnonzero(np.isin(ids, wrong.landmark_ids))[::9]
    ids[rows] = np.roll(ids[rows], 1)
    bundle = replace(wrong.bundle, point_ids=ids)
    robots[1] = Robot(wrong.name, bundle, wrong.landmark_ids)
    _, rounds = refine(robots, 2)
    first, second = (set(each.fusion.contradictions) for each in rounds)
    assert first
    assert first <= second


@pytest.mark.parametrize('gauge', [Gauge.RIGID, Gauge.YAW_TRANSLATION])
def test_metric_robots_converge_and_remember_what_their_prior_said(gauge):
    fleet = simulate_fleet(FleetConfig(sensing=Sensing(gauge=gauge)), 4)
    first = fuse(fleet.submaps())
    robots, rounds = refine(robots_of(fleet), 5)
    assert rounds[-1].step_ratio < 1e-4
    assert any(np.abs(robot.bundle.prior_residuals_px).max() > 0.0 for robot in robots)
    a, b = first.components[0].landmarks, rounds[-1].fusion.components[0].landmarks
    S = align(a.points_global, b.points_global, gauge=gauge).S_target_source
    moves = np.linalg.norm(S.apply(b.points_global) - a.points_global, axis=1)
    assert np.median(moves / np.linalg.norm(a.std, axis=1)) < 0.5
    assert abs(align(a.points_global, b.points_global).S_target_source.scale - 1.0) < 1e-3


def test_a_robot_keeps_its_landmarks_where_it_is_told():
    fleet = simulate_fleet(FleetConfig(), 5)
    bundle, rows = fleet.bundles[0], fleet.shared_rows(0)
    ids = bundle.point_ids[rows]
    nudged = bundle.points[rows] + 1e-3 * np.random.default_rng(5).normal(size=(len(rows), 3))
    found = relinearise(bundle, ids, nudged)
    assert found.converged
    moved = found.bundle.points[rows]
    S = align(moved, nudged).S_target_source
    np.testing.assert_allclose(S.apply(nudged), moved, atol=1e-12)
    # What is left of the gradient is about the landmarks alone: everything else is at its best.
    submap = compress(found.bundle, MapName('a', 'a'), ids, dtype=np.float64)
    assert np.isclose(submap.a**2 + submap.c @ submap.c, found.cost_px2, rtol=1e-9)
    assert linearise(found.bundle).cost_px2 == found.cost_px2


def test_a_step_behind_a_camera_is_shortened(monkeypatch):
    from mapmerge_ros.fusion import refine as module

    honest, costs = module._relinearised, []

    def shy(*args):
        costs.append(None)
        if len(costs) == 2:  # all of the second round's step
            raise InvalidValue('points: point 7 is behind a camera that observes it')
        robots, costs[-1] = honest(*args)
        return robots, costs[-1]

    monkeypatch.setattr(module, '_relinearised', shy)
    _, rounds = refine(robots_of(simulate_fleet(FleetConfig(), 6)), 2)
    assert [each.share for each in rounds] == [1.0, 0.5]
    assert costs[2] <= costs[0]
    costs[:] = [None]
    with pytest.raises(InvalidValue, match='behind a camera'):  # nowhere to shorten it to
        refine(robots_of(simulate_fleet(FleetConfig(), 6)), 1)


def test_a_step_that_is_too_long_is_shortened(monkeypatch):
    """Landmarks thrown ten times too far would raise the true cost; the rounds do not."""
    from mapmerge_ros.fusion import refine as module

    fleet, honest, calls = simulate_fleet(FleetConfig(), 6), module._landmarks, []

    def exaggerated(fusion):
        points = honest(fusion)
        calls.append(points)
        if len(calls) == 1:
            return points
        before = module._in_frame_of(points, calls[-2]).points_global
        noise = np.random.default_rng(len(calls)).normal(size=before.shape)
        return module._Points(points.ids, points.points_global + 0.05 * noise)

    monkeypatch.setattr(module, '_landmarks', exaggerated)
    _, rounds = refine(robots_of(fleet), 4)
    costs = [each.cost_px2 for each in rounds]
    assert all(after <= before for before, after in itertools.pairwise(costs))
    assert any(each.share < 1.0 for each in rounds)


def test_rounds_need_robots_that_hang_together():
    fleet = simulate_fleet(FleetConfig(), 7)
    robots = robots_of(fleet)
    with pytest.raises(InvalidValue, match='0 rounds'):
        refine(robots, 0)
    apart = [replace(r, name=replace(r.name, id_space=r.name.map_id)) for r in robots]
    with pytest.raises(Exception, match='hang together'):
        refine(apart, 2)


def test_the_command_refines_real_models(tmp_path, capsys):
    folder = DATA / 'brighton_drone'
    if not folder.is_dir():
        pytest.skip(f'{folder} is not there: real data is not shipped')
    out = tmp_path / 'refined'
    command = ['refine', str(folder / 'session_0'), str(folder / 'session_1'), '--rounds', '3']
    assert main([*command, '--id-space', 'truth', '--out', str(out)]) == 0
    assert 'true cost' in capsys.readouterr().out
    lines = (out / 'keyframes.csv').read_text().splitlines()
    assert len(lines) == 1 + 9 + 9
    assert (out / 'report.html').exists()
    assert main(command) == 2
    assert '--id-space' in capsys.readouterr().err


def test_what_the_global_map_has_room_for_is_no_matter_of_the_rounds():
    """A fleet has more landmarks than one map may have compressed: all are handed back."""
    fleet = simulate_fleet(FleetConfig(), 3)
    (_, wide), (robots, narrow) = (
        refine(robots_of(fleet), 2, FusionConfig(max_landmarks=size)) for size in (10**6, 12)
    )
    component = narrow[-1].fusion.components[0]
    assert component.submap.compressed_count == 12
    assert len(component.landmarks.ids) == len(wide[-1].fusion.components[0].landmarks.ids)
    assert narrow[-1].cost_px2 == pytest.approx(wide[-1].cost_px2, rel=1e-12)
    assert all(len(robot.landmark_ids) > 12 for robot in robots)
