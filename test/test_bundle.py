# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Compression against dense QR, at and off the optimum, in every gauge; and the way back."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import assert_same_elimination, random_bundle

from mapmerge_ros.bundle import MapName, compress, eliminate, linearise
from mapmerge_ros.bundle.dense import dense_jacobian
from mapmerge_ros.bundle.follow import follow
from mapmerge_ros.errors import DegenerateGeometry, InvalidValue
from mapmerge_ros.geometry import Gauge, Similarity, gauge_basis
from mapmerge_ros.submap import factor_information, pack, packed_size, unpack

GAUGES = [Gauge.SIMILARITY, Gauge.RIGID, Gauge.YAW_TRANSLATION, Gauge.NONE]


def test_jacobian_is_the_derivative_of_the_residual():
    bundle = random_bundle(1, off=0.02)
    rng, step = np.random.default_rng(0), 1e-6
    poses, points = rng.normal(size=(6, 6)), rng.normal(size=(30, 3))
    lin = linearise(bundle)
    ahead = linearise(bundle.moved(step * poses, step * points)).residuals_px
    behind = linearise(bundle.moved(-step * poses, -step * points)).residuals_px
    analytic = np.einsum('oij,oj->oi', lin.by_pose, poses[bundle.observation_keyframes])
    analytic += np.einsum('oij,oj->oi', lin.by_point, points[bundle.observation_points])
    scale = np.abs(analytic).max()
    np.testing.assert_allclose((ahead - behind) / (2 * step) / scale, analytic / scale, atol=1e-8)


@pytest.mark.parametrize('gauge', GAUGES)
@pytest.mark.parametrize('method', ['schur', 'qr', 'auto'])
@pytest.mark.parametrize('off', [0.0, 0.02])
def test_elimination_equals_dense_qr(gauge, method, off):
    lin = linearise(random_bundle(2, gauge=gauge, off=off))
    shared = np.array([3, 7, 1, 20, 11, 29, 4])
    fast, dense = eliminate(lin, shared, method), eliminate(lin, shared, 'dense')
    assert fast.r.shape == (21 - int(gauge), 21)
    assert_same_elimination(fast, dense)


@pytest.mark.parametrize('gauge', GAUGES)
def test_the_compressed_cost_is_the_minimum_over_everything_else(gauge):
    """a² + |R dq + c|² against least squares of all the rest, the shared points moved."""
    lin = linearise(random_bundle(3, gauge=gauge, off=0.01))
    shared = np.arange(5, 11)
    found = eliminate(lin, shared)
    jacobian, residuals = dense_jacobian(lin)
    columns = 36 + (3 * shared[:, None] + np.arange(3)).ravel()
    others = np.setdiff1d(np.arange(jacobian.shape[1]), columns)
    for seed in range(3):
        moved = 0.01 * np.random.default_rng(seed).normal(size=18)
        shifted = residuals + jacobian[:, columns] @ moved
        step = np.linalg.lstsq(jacobian[:, others], -shifted, rcond=None)[0]
        direct = np.sum((shifted + jacobian[:, others] @ step) ** 2)
        compact = found.a**2 + np.sum((found.r @ moved + found.c) ** 2)
        np.testing.assert_allclose(compact, direct, rtol=1e-9)
        pose_steps, point_steps, _ = found.steps(lin, moved.reshape(-1, 3))
        np.testing.assert_allclose(pose_steps.ravel(), step[:36], atol=1e-7)
        rest = np.delete(point_steps, shared, axis=0).ravel()
        np.testing.assert_allclose(rest, step[36:], atol=1e-7)


@pytest.mark.parametrize('gauge', GAUGES)
def test_r_has_the_null_space_of_the_gauge_and_no_more(gauge):
    bundle = random_bundle(4, gauge=gauge)
    shared = np.arange(8)
    r = eliminate(linearise(bundle), shared).r
    basis = gauge_basis(bundle.points[shared], gauge)
    assert np.abs(r @ basis).max(initial=0.0) < 1e-9 * np.abs(r).max()
    assert np.linalg.matrix_rank(r) == 24 - int(gauge)


@pytest.mark.parametrize('method', ['schur', 'qr'])
@pytest.mark.parametrize('spacing', [1.0, 1e-2, 1e-3])
def test_last_landmarks_may_hold_the_frame_badly(method, spacing):
    """R is as right as the information is, even if its last rows are about one small place."""
    for seed in range(3):
        bundle = random_bundle(seed, keyframes=8, points=60)
        middle = bundle.points[-3:].mean(axis=0)
        points = np.array(bundle.points)
        points[-3:] = middle + spacing * (points[-3:] - middle)
        lin = linearise(replace(bundle, points=points))
        shared = np.r_[:30, 57:60]
        fast, dense = eliminate(lin, shared, method), eliminate(lin, shared, 'dense')
        expected = dense.r.T @ dense.r
        difference = np.abs(fast.r.T @ fast.r - expected).max() / np.abs(expected).max()
        assert difference < 1e-12
        assert not np.tril(fast.r, -1).any()


@pytest.mark.parametrize('count', [4, 21, 22, 23, 24, 43, 64])
@pytest.mark.parametrize('gauge', GAUGES)
def test_factors_of_every_size_lose_the_gauge_and_nothing_else(count, gauge):
    """Sizes about those of the blocks in which the gauge is rotated out."""
    rng = np.random.default_rng(count)
    null_basis = gauge_basis(rng.normal(size=(count, 3)), gauge)
    columns = 3 * count
    root = rng.normal(size=(2 * columns, columns))
    root -= root @ null_basis @ null_basis.T
    gradient = root.T @ rng.normal(size=2 * columns)
    r, c = factor_information(root.T @ root, gradient, null_basis)
    assert r.shape == (columns - int(gauge), columns)
    assert not np.tril(r, -1).any()
    np.testing.assert_allclose(r.T @ r, root.T @ root, atol=1e-11 * columns)
    np.testing.assert_allclose(r.T @ c, gradient, atol=1e-10 * columns)


def test_ill_conditioned_sessions_go_through_qr():
    """A baseline of a hundred-thousandth of the distance: Schur loses digits, QR does not."""
    lin = linearise(random_bundle(5, spread=1e-5, noise_px=0.0))
    shared = np.arange(6)
    dense = eliminate(lin, shared, 'dense')
    found = eliminate(lin, shared, 'auto')
    columns = np.linalg.norm(dense.r, axis=0)
    difference = np.abs(found.r.T @ found.r - dense.r.T @ dense.r) / np.outer(columns, columns)
    assert difference.max() < 1e-8


def test_the_prior_of_a_metric_map_knows_scale_and_gravity():
    bundle = random_bundle(6, gauge=Gauge.YAW_TRANSLATION)
    rows = linearise(bundle).prior_rows
    step = 1e-6

    def deviation(S):
        """Pose steps that carry the bundle into the frame S, through the prior's rows."""
        moved = bundle.transformed(S)
        shift = moved.translations_camera_map - bundle.translations_camera_map
        turn = moved.rotations_camera_map @ bundle.rotations_camera_map.transpose(0, 2, 1)
        vectors = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
        return rows @ np.hstack([vectors, shift]).ravel() / step

    def tangent(slot):
        return Similarity.exp(step * np.eye(7)[slot])

    scale, roll, yaw = deviation(tangent(6)), deviation(tangent(0)), deviation(tangent(2))
    np.testing.assert_allclose(scale[0], 1.0 / bundle.prior.scale_std_ratio, rtol=1e-4)
    np.testing.assert_allclose(np.abs(roll[1]), 1.0 / bundle.prior.gravity_std_rad, rtol=1e-4)
    np.testing.assert_allclose(yaw, 0.0, atol=1e-3)


def test_update_brings_back_cameras_and_points():
    """Landmarks at their truth, in a foreign frame, pull the rest of the bundle to its truth."""
    truth = random_bundle(7, noise_px=0.0)
    rng = np.random.default_rng(7)
    bent = truth.moved(2e-4 * rng.normal(size=(6, 6)), 2e-4 * rng.normal(size=(30, 3)))
    shared = np.arange(12)
    S_global_map = Similarity.exp(rng.normal(size=7))
    ids, known = truth.point_ids[shared], S_global_map.apply(truth.points[shared])
    update = bent.update(ids, known)
    true_map = update.S_map_global.apply(S_global_map.apply(truth.points))
    before = np.abs(bent.points - truth.points).max()
    assert np.abs(update.bundle.points - true_map).max() < 1e-2 * before
    assert linearise(update.bundle).cost_px2 < 1e-4 * linearise(bent).cost_px2


def bundle_with_a_weak_point():
    """The first point is seen from two key frames half a millimetre apart."""
    bundle = random_bundle(3)
    rotations, translations = (
        each.copy() for each in (bundle.rotations_camera_map, bundle.translations_camera_map)
    )
    rotations[1], translations[1] = rotations[0], translations[0] + np.array([5e-4, 0.0, 0.0])
    # The two have no other point in common, so what they answer differs.
    seen, seers = bundle.observation_points, bundle.observation_keyframes
    kept = np.where(seen == 0, seers < 2, (seers > 1) | (seen % 2 == seers))
    bundle = replace(
        bundle,
        rotations_camera_map=rotations,
        translations_camera_map=translations,
        observation_keyframes=seers[kept],
        observation_points=seen[kept],
        observations_px=bundle.observations_px[kept],
    )
    exact = bundle.observations_px + linearise(bundle).residuals_px
    return replace(bundle, observations_px=exact)


def test_a_weak_point_whose_answer_is_behind_its_cameras_goes_with_them():
    bundle, rows = bundle_with_a_weak_point(), np.arange(1, 30)
    lin, own = linearise(bundle), bundle.observation_points == 0
    found, before = eliminate(lin, rows), bundle.points_camera()[own]
    steps, answer = 2e-3 * np.random.default_rng(3).normal(size=(29, 3)), 0.0
    for signed in (steps, -steps):  # one takes it away from the cameras, the other through them
        try:
            expected = lin.moved(*found.steps(lin, signed)).points
        except InvalidValue:
            after = follow(lin, rows, found.steps(lin, signed))
            np.testing.assert_array_equal(after.points[rows], bundle.points[rows] + signed)
            assert np.abs(after.points_camera()[own] - before).max() < 0.1
        else:
            answer = np.linalg.norm(expected[0] - bundle.points[0])
            np.testing.assert_array_equal(
                follow(lin, rows, found.steps(lin, signed)).points, expected
            )
    assert answer > before[:, 2].max()


def test_update_leaves_out_a_landmark_that_would_be_behind_a_camera():
    bundle = bundle_with_a_weak_point()
    ids, places = bundle.point_ids[:12], bundle.points[:12].copy()
    axis = bundle.rotations_camera_map[0][2]
    places[0] = bundle.centres_map()[0] - axis
    update, expected = bundle.update(ids, places), bundle.update(ids[1:], places[1:])
    assert update.left_out_ids.tolist() == [ids[0]]
    assert expected.left_out_ids.size == 0
    np.testing.assert_array_equal(update.bundle.points, expected.bundle.points)


def test_a_submap_says_what_the_bundle_knows():
    bundle = random_bundle(8)
    ids = bundle.point_ids[[4, 2, 9, 17]]
    submap = compress(bundle, MapName('drone1/0001', 'drone1', id_space='site'), ids)
    np.testing.assert_array_equal(submap.compressed_ids, ids)
    assert len(submap.landmark_ids) == 30
    assert submap.compressed_count == 4
    assert submap.residual_count == bundle.observations_px.size
    assert submap.dof == 6 * 6 + 3 * 30 - 7
    assert submap.sources[0].map_id == 'drone1/0001'
    announcement = compress(bundle, MapName('drone1/0001', 'drone1'), [])
    assert announcement.compressed_count == 0
    assert len(announcement.landmark_ids) == 30


@pytest.mark.parametrize('gauge', GAUGES)
def test_a_submap_in_another_frame_knows_the_same(gauge):
    bundle = random_bundle(9, gauge=gauge, off=0.01)
    submap = compress(bundle, MapName('a', 'a'), bundle.point_ids[:7])
    S = Similarity.exp(np.random.default_rng(9).normal(size=7))
    moved = submap.transformed(S)
    step = np.random.default_rng(1).normal(size=(7, 3))
    before = np.sum((submap.triangle() @ step.ravel() + submap.c) ** 2)
    after = np.sum((moved.triangle() @ S.rotate(step).ravel() + moved.c) ** 2)
    np.testing.assert_allclose(after, before, rtol=1e-5)  # float32 R


def test_packing_is_the_identity():
    for rows, columns in [(2, 9), (14, 21), (21, 21), (0, 0)]:
        trapezoid = np.triu(np.random.default_rng(0).normal(size=(rows, columns)))
        packed = pack(trapezoid)
        assert len(packed) == packed_size(rows, columns)
        np.testing.assert_array_equal(unpack(packed, columns, rows), trapezoid)


def test_bad_bundles_are_refused_by_name():
    bundle = random_bundle(10)
    cases = {
        'keyframe_cameras': {'keyframe_cameras': np.full(6, 9)},
        'observations_px': {'observations_px': np.full_like(bundle.observations_px, np.nan)},
        'points': {'points': -40.0 * np.ones((30, 3))},
        'point_ids': {'point_ids': np.zeros(30)},
        'intrinsics': {'intrinsics': -bundle.intrinsics},
        'sigma_px': {'sigma_px': -1.0},
        'translations_camera_map': {'translations_camera_map': np.zeros((2, 3))},
    }
    for name, change in cases.items():
        with pytest.raises(InvalidValue, match=name):
            replace(bundle, **change)
    with pytest.raises(InvalidValue, match='point 5 is not in this bundle'):
        compress(bundle, MapName('a', 'a'), [5])
    with pytest.raises((DegenerateGeometry, InvalidValue)):
        compress(bundle, MapName('a', 'a'), bundle.point_ids[:2])
