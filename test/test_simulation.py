# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated robots: maps at their optimum, in frames that truth explains, the same by seed."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from mapmerge_ros.bundle import FramePrior, compress, eliminate, linearise
from mapmerge_ros.fusion import fuse
from mapmerge_ros.geometry import Gauge, align
from mapmerge_ros.simulation import (
    Fleet,
    FleetConfig,
    Sensing,
    SimulationError,
    all_around,
    anchored,
    arc,
    box_scene,
    box_truth,
    fly,
    joint_bundle,
    measured,
    observe,
    paper_box,
    room_scene,
    simulate_fleet,
    solve,
    yard_scene,
)

pytest.importorskip('pycolmap', reason='pycolmap is missing: pip install mapmerge_ros[colmap]')


@pytest.fixture(scope='module')
def fleet() -> Fleet:
    """Four drones with the default settings."""
    return simulate_fleet(seed=3)


def test_adjusted_bundle_is_at_its_optimum(fleet: Fleet) -> None:
    for robot, bundle in enumerate(fleet.bundles):
        found = eliminate(linearise(bundle), fleet.shared_rows(robot))
        assert np.linalg.norm(found.c) < 1e-4 * bundle.sigma_px
        assert np.abs(found.session_offset).max() < 1e-6


def test_early_stop_leaves_a_gradient_and_says_so() -> None:
    bundle = simulate_fleet(FleetConfig(max_iterations=1), seed=3).bundles[0]
    assert np.linalg.norm(eliminate(linearise(bundle), np.arange(30)).c) > 0.1
    stopped, finished = solve(bundle, max_iterations=1), solve(bundle)
    assert not stopped.converged
    assert finished.converged
    assert 1 < finished.iterations < 20
    assert finished.cost_px2 < stopped.cost_px2


def test_cost_of_the_solver_is_that_of_linearise(fleet: Fleet) -> None:
    again = solve(fleet.bundles[0])
    assert again.cost_px2 == pytest.approx(linearise(again.bundle).cost_px2, rel=1e-12)


@pytest.mark.parametrize('gauge', list(Gauge))
def test_without_noise_the_truth_is_recovered_up_to_the_frame(gauge: Gauge) -> None:
    quiet = simulate_fleet(FleetConfig(drones=2, sensing=Sensing(sigma_px=0.0, gauge=gauge)))
    truth = quiet.truth
    for bundle, true, S_world_map in zip(
        quiet.bundles, truth.bundles, truth.S_world_map, strict=True
    ):
        assert np.abs(S_world_map.apply(bundle.points) - true.points).max() < 1e-5
        placed = bundle.transformed(S_world_map)
        turns = placed.rotations_camera_map - true.rotations_camera_map
        assert np.abs(turns).max() < 1e-6


def test_residuals_have_the_stated_sigma() -> None:
    maps = paper_box(np.random.default_rng(5), sigma=0.01, maps=20)
    cost = sum(linearise(bundle).cost_px2 for bundle in maps)
    freedom = sum(bundle.residual_count - bundle.dof for bundle in maps)
    assert cost / freedom == pytest.approx(0.01**2, rel=0.05)


def test_drones_too_have_the_stated_sigma(fleet: Fleet) -> None:
    cost = sum(linearise(bundle).cost_px2 for bundle in fleet.bundles)
    freedom = sum(bundle.residual_count - bundle.dof for bundle in fleet.bundles)
    assert cost / freedom == pytest.approx(0.25, rel=0.05)


def test_frames_relate_to_the_world_as_stated(fleet: Fleet) -> None:
    truth = fleet.truth
    for bundle, true, S_world_map in zip(
        fleet.bundles, truth.bundles, truth.S_world_map, strict=True
    ):
        errors = np.linalg.norm(S_world_map.apply(bundle.points) - true.points, axis=1)
        assert np.median(errors) < 0.1
        best = align(true.points, bundle.points).S_target_source
        assert best.scale == pytest.approx(S_world_map.scale, rel=0.02)
    scales = [S.scale for S in truth.S_world_map]
    assert max(scales) / min(scales) > 1.1


def test_same_seed_same_fleet(fleet: Fleet) -> None:
    again, other = simulate_fleet(seed=3), simulate_fleet(seed=4)
    for one, two, three in zip(fleet.bundles, again.bundles, other.bundles, strict=True):
        assert one.points.tobytes() == two.points.tobytes()
        assert one.descriptors.rows.tobytes() == two.descriptors.rows.tobytes()
        assert one.points.tobytes() != three.points.tobytes()


def test_default_fleet_overlaps_in_a_ring_and_fits_a_small_recording(fleet: Fleet) -> None:
    ids = fleet.truth.landmark_ids
    assert all(150 <= len(own) <= 300 for own in ids)
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
        assert 20 <= len(np.intersect1d(ids[a], ids[b])) <= 60
    submaps = fleet.submaps()
    assert sum(s.packed_r.nbytes + 88 * len(s.landmark_ids) for s in submaps) < 1_000_000
    assert len({submap.map_id for submap in submaps}) == 4


@pytest.mark.parametrize('gauge', [Gauge.RIGID, Gauge.YAW_TRANSLATION, Gauge.NONE])
def test_metric_gauges_keep_what_they_know(gauge: Gauge) -> None:
    prior = FramePrior(
        scale_std_ratio=1e-4, gravity_std_rad=1e-4, heading_std_rad=1e-4, position_std=1e-3
    )
    config = FleetConfig(drones=2, sensing=Sensing(gauge=gauge, prior=prior))
    truth = simulate_fleet(config, seed=1).truth
    for S_world_map in truth.S_world_map:
        assert S_world_map.scale == pytest.approx(1.0, abs=5e-4)
        if gauge <= Gauge.YAW_TRANSLATION:
            assert S_world_map.rotation[2, 2] == pytest.approx(1.0, abs=1e-6)
        if gauge is Gauge.NONE:
            assert np.abs(S_world_map.rotation - np.eye(3)).max() < 1e-3


def test_adjustment_keeps_scale_and_mean_pose(fleet: Fleet) -> None:
    rng = np.random.default_rng(0)
    bundle = fleet.bundles[0]
    start = bundle.moved(
        1e-3 * rng.normal(size=(len(bundle.keyframe_ids), 6)), np.zeros(bundle.points.shape)
    )
    adjusted = solve(start).bundle
    assert adjusted.centres_map().mean(axis=0) == pytest.approx(start.centres_map().mean(axis=0))
    assert adjusted.points == pytest.approx(anchored(bundle, start).points, abs=1e-5)


def test_frame_errors_have_the_spread_of_the_prior() -> None:
    prior = FramePrior(scale_std_ratio=0.02, gravity_std_rad=0.01)
    config = FleetConfig(drones=1, sensing=Sensing(gauge=Gauge.YAW_TRANSLATION, prior=prior))
    frames = [simulate_fleet(config, seed).truth.S_world_map[0] for seed in range(60)]
    assert np.std([np.log(S.scale) for S in frames]) == pytest.approx(0.02, rel=0.3)
    tilts = np.array([S.rotation[2, :2] for S in frames])
    assert np.std(tilts) == pytest.approx(0.01, rel=0.2)


def test_moved_objects_are_displaced_as_stated() -> None:
    config = FleetConfig(moved=2, moved_distance=0.8, sensing=Sensing(sigma_px=0.0))
    fleet = simulate_fleet(config, seed=2)
    truth = fleet.truth
    assert len(truth.moved) == 2
    for moved in truth.moved:
        assert np.linalg.norm(moved.displacement_world) == pytest.approx(0.8)
        seen = truth.sees(moved.landmark_ids)
        assert seen[: moved.first_visit_after].any()
        assert seen[moved.first_visit_after :].any()
        for visit, bundle in enumerate(fleet.bundles):
            ids = moved.landmark_ids[seen[visit]]
            rows = np.searchsorted(truth.landmark_ids[visit], ids)
            points_world = truth.S_world_map[visit].apply(bundle.points[rows])
            wanted = moved.displacement_world * (visit >= moved.first_visit_after)
            assert points_world - truth.points_world(ids) == pytest.approx(
                np.tile(wanted, (len(ids), 1)), abs=1e-4
            )
    unmoved = np.setdiff1d(truth.scene.ids, np.concatenate([m.landmark_ids for m in truth.moved]))
    for own, true in zip(truth.landmark_ids, truth.bundles, strict=True):
        still = np.isin(own, unmoved)
        assert np.array_equal(true.points[still], truth.points_world(own[still]))


def test_more_moved_objects_than_there_are() -> None:
    with pytest.raises(SimulationError, match='moved: 1000 objects'):
        simulate_fleet(FleetConfig(drones=2, moved=1000))


def test_private_ids_differ_and_descriptors_tell() -> None:
    fleet = simulate_fleet(FleetConfig(drones=2, ids='private'), seed=3)
    assert {name.id_space for name in fleet.names} == {''}
    first, second = fleet.truth.landmark_ids
    _, rows_a, rows_b = np.intersect1d(first, second, return_indices=True)
    a, b = fleet.bundles
    assert not np.array_equal(a.point_ids[rows_a], b.point_ids[rows_b])
    differing = a.descriptors.rows[rows_a, None] ^ b.descriptors.rows[None, rows_b]
    distances = np.unpackbits(differing, axis=2).sum(axis=2)
    assert np.array_equal(distances.argmin(axis=1), np.arange(len(rows_a)))
    assert 5 < np.diag(distances).mean() < 25


def test_ids_of_the_fleet_are_those_of_the_scene(fleet: Fleet) -> None:
    for bundle, ids in zip(fleet.bundles, fleet.truth.landmark_ids, strict=True):
        assert np.array_equal(bundle.point_ids, ids)
    assert {name.id_space for name in fleet.names} == {'fleet'}


def test_joint_bundle_costs_more_than_the_parts_by_its_dof(fleet: Fleet) -> None:
    joint = joint_bundle(fleet)
    own = sum(linearise(bundle).cost_px2 for bundle in fleet.bundles)
    price = (solve(joint).cost_px2 - own) / 0.25
    dof = sum(bundle.dof for bundle in fleet.bundles) - joint.dof
    assert abs(price - dof) < 4.0 * np.sqrt(2.0 * dof)


def test_paper_box_is_what_the_paper_says() -> None:
    rng = np.random.default_rng(0)
    truth = box_truth(rng)
    assert [bundle.observations_px.shape for bundle in truth] == [(1000, 2)] * 3
    assert np.abs(truth[0].points).max(axis=0) == pytest.approx([5.0, 3.0, 1.0], rel=0.1)
    assert linearise(truth[0]).cost_px2 < 1e-20
    assert np.abs(truth[0].centres_map() - truth[1].centres_map()).max() > 1.0
    started = time.perf_counter()
    maps = measured(truth, rng, 0.05)
    assert time.perf_counter() - started < 1.0
    for bundle in maps:
        found = eliminate(linearise(bundle), np.arange(10))
        assert np.linalg.norm(found.c) < 1e-3 * 0.05
    assert maps[0].point_ids.tolist() == maps[2].point_ids.tolist()


def test_paper_box_with_missed_points() -> None:
    maps = paper_box(np.random.default_rng(0), sigma=0.005, seen_ratio=0.8)
    assert all(1400 < bundle.observations_px.size < 1800 for bundle in maps)


def test_room_has_corners_on_both_walls() -> None:
    room = room_scene(np.random.default_rng(0), 50)
    half = np.array([2.5, 3.0, 1.0])
    assert len(room) == 4 * 50 + 4 * 6
    assert (np.abs(room.points) <= half + 1e-12).all()
    inwards = np.einsum('ni,ni->n', room.normals, -room.points)
    assert (inwards > 0.0).all()
    at_corner = room.points[room.surfaces >= 4]
    to_walls = half[:2] - np.abs(at_corner[:, :2])
    assert (to_walls.min(axis=1) < 1e-9).all()
    assert (to_walls.max(axis=1) <= 0.5).all()
    assert np.sign(at_corner[:6, :2]).tolist() == [[1.0, 1.0]] * 6


def test_a_facade_is_seen_from_its_front_only() -> None:
    rng = np.random.default_rng(0)
    yard = yard_scene(rng, 2000, (30.0, 30.0), houses=1)
    path = arc(np.zeros(3), 25.0, 8.0, 20, (-0.5, 0.5))
    seen = observe(rng, yard, path, Sensing())
    rows = np.searchsorted(yard.ids, seen.point_ids)
    assert yard.normals[rows, 0].min() > -0.5
    assert (yard.normals[rows, 0] > 0.5).any()


def test_a_drone_that_sees_nothing_is_told() -> None:
    rng = np.random.default_rng(0)
    away = arc(np.array([500.0, 0.0, 0.0]), 25.0, 8.0, 20, (-0.5, 0.5))
    with pytest.raises(SimulationError, match='a drone sees 0 landmarks'):
        fly(rng, yard_scene(rng, 500), away)


def test_sixty_cameras_and_a_thousand_points_take_moments() -> None:
    rng = np.random.default_rng(0)
    path = all_around(rng, np.zeros(3), (10.0, 14.0), 60)
    flight = fly(rng, box_scene(rng, 1000), path, Sensing(detection_ratio=0.25))
    start = flight.bundle.moved(
        np.zeros((60, 6)), 0.01 * rng.normal(size=flight.bundle.points.shape)
    )
    started = time.perf_counter()
    assert solve(start).converged
    assert time.perf_counter() - started < 2.0


def test_a_simulated_map_compresses_exactly_in_any_gauge_of_its_own(fleet: Fleet) -> None:
    bundle, name = fleet.bundles[0], fleet.names[0]
    ids = bundle.point_ids[fleet.shared_rows(0)]
    small = compress(bundle, name, ids)
    rigid = compress(replace(bundle, gauge=Gauge.RIGID), name, ids)
    # A known scale adds information in one direction and takes it from none.
    gain = rigid.triangle().T @ rigid.triangle() - small.triangle().T @ small.triangle()
    values = np.linalg.eigvalsh(gain)
    assert np.abs(values[:-1]).max() < 1e-4 * values[-1] + 1e-6 * np.sum(small.triangle() ** 2)


def test_what_came_or_went_is_seen_by_those_who_were_there_alone():
    fleet = simulate_fleet(FleetConfig(added=1, removed=1), 3)
    came, went = fleet.truth.temporary
    for stay in (came, went):
        seen = fleet.truth.sees(stay.landmark_ids)
        for visit in range(4):
            assert stay.is_there(visit) or not seen[visit].any()
        assert seen.any()
    assert came.first_visit > 0
    assert came.visit_after == 4
    assert went.first_visit == 0
    assert went.visit_after < 4


def test_what_is_not_seen_again_has_not_moved():
    for seed in range(3):
        submaps = simulate_fleet(FleetConfig(added=1, removed=1), seed).submaps()
        found = fuse(submaps).components[0].examination
        assert not found.objects
