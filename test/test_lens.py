# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Lens parameters as nuisance: exact elimination, honest merges of wrong calibrations."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scenes import assert_same_elimination, random_bundle

from mapmerge_ros.bundle import (
    Lens,
    MapName,
    compress,
    eliminate,
    linearise,
    with_lens_prior,
)
from mapmerge_ros.bundle.dense import dense_jacobian
from mapmerge_ros.cli.compress import with_uncertain_lens
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import fuse
from mapmerge_ros.fusion.refine import Robot, refine
from mapmerge_ros.geometry import Gauge, align, gauge_basis

GAUGES = [Gauge.SIMILARITY, Gauge.RIGID, Gauge.YAW_TRANSLATION, Gauge.NONE]


def bent_bundle(seed, *, gauge=Gauge.SIMILARITY, off=0.0, moved_px=0.0):
    """A random bundle of two cameras whose lenses are uncertain, and moved."""
    bundle = with_lens_prior(random_bundle(seed, gauge=gauge, off=off), 0.12)
    moved = moved_px * np.random.default_rng(seed).normal(size=(2, 7))
    return replace(bundle, lens=replace(bundle.lens, moved_px=moved))


@pytest.mark.parametrize('moved_px', [0.0, 3.0])
def test_jacobian_is_the_derivative_of_the_residual(moved_px):
    bundle = bent_bundle(1, off=0.02, moved_px=moved_px)
    rng, step = np.random.default_rng(0), 1e-6
    steps = rng.normal(size=(6, 6)), rng.normal(size=(30, 3)), rng.normal(size=(2, 7))
    lin = linearise(bundle)
    ahead, behind = (linearise(lin.moved(*(sign * s for s in steps))) for sign in (step, -step))
    jacobian, _ = dense_jacobian(lin)
    analytic = jacobian @ np.concatenate([steps[k].ravel() for k in (0, 2, 1)])
    difference = (ahead.residuals_px - behind.residuals_px).ravel() / (2 * step)
    scale = np.abs(difference).max()
    np.testing.assert_allclose(difference / scale, analytic[: len(difference)] / scale, atol=1e-8)
    known = (ahead.known_residuals_px - behind.known_residuals_px) / (2 * step)
    np.testing.assert_allclose(analytic[len(difference) :], known, atol=1e-6)


@pytest.mark.parametrize('gauge', GAUGES)
@pytest.mark.parametrize('method', ['schur', 'qr', 'auto'])
@pytest.mark.parametrize('off', [0.0, 0.02])
def test_elimination_equals_dense_qr(gauge, method, off):
    lin = linearise(bent_bundle(2, gauge=gauge, off=off, moved_px=50 * off))
    shared = np.array([3, 7, 1, 20, 11, 29, 4])
    fast, dense = eliminate(lin, shared, method), eliminate(lin, shared, 'dense')
    assert_same_elimination(fast, dense)
    null = gauge_basis(lin.bundle.points[shared], gauge)
    assert np.abs(fast.r @ null).max(initial=0.0) < 1e-8 * np.abs(fast.r).max()


def test_a_parameter_moves_the_image_by_its_pixels():
    bundle = bent_bundle(3)
    of_first = bundle.keyframe_cameras[bundle.observation_keyframes] == 0
    by_lens = linearise(bundle).by_lens
    # Scaled at the observations, not where the noisy points project to: about 1 px.
    rms = np.sqrt(np.mean(np.sum(by_lens[of_first] ** 2, axis=1), axis=0))
    np.testing.assert_allclose(rms[:7], 1.0, rtol=0.02)
    assert not by_lens[of_first][:, :, 7:].any()


def test_a_very_sure_prior_is_a_calibrated_camera():
    plain = random_bundle(4, off=0.01)
    sure = with_lens_prior(plain, 1e-7)
    shared = np.arange(8)
    fixed, tight = eliminate(linearise(plain), shared), eliminate(linearise(sure), shared)
    size = np.abs(fixed.r).max() ** 2
    np.testing.assert_allclose(tight.r.T @ tight.r / size, fixed.r.T @ fixed.r / size, atol=1e-8)
    np.testing.assert_allclose(tight.a, fixed.a, rtol=1e-6)
    assert sure.residual_count - sure.dof == plain.residual_count - plain.dof
    loose = eliminate(linearise(with_lens_prior(plain, 0.2)), shared)
    lost = np.linalg.eigvalsh(fixed.r.T @ fixed.r - loose.r.T @ loose.r)
    assert lost.min() > -1e-9 * size and lost.max() > 1e-3 * size


def test_switched_off_where_it_means_nothing():
    plain = random_bundle(5)
    assert with_lens_prior(with_lens_prior(plain, 0.1), 0.0).lens.size == 0
    own = replace(
        plain, intrinsics=np.tile(plain.intrinsics[:1], (6, 1)), keyframe_cameras=np.arange(6)
    )
    assert with_lens_prior(own, 0.1).lens.size == 0
    rare = replace(plain, keyframe_cameras=np.array([0, 0, 0, 0, 1, 1]))
    np.testing.assert_array_equal(with_lens_prior(rare, 0.1).lens.cameras, [0])
    with pytest.raises(InvalidValue, match='lens prior'):
        with_lens_prior(plain, -1.0)
    with pytest.raises(InvalidValue, match=r'lens.cameras'):
        replace(plain, lens=Lens(np.array([7]), np.ones((1, 7)), np.zeros((1, 7)), 1.0))


def test_counts_keep_the_estimate_of_sigma_unbiased():
    """a² / (η - d) over many sessions whose lenses err as the prior says."""
    factors = []
    truth = random_bundle(6, noise_px=0.0)
    for seed in range(300):
        rng = np.random.default_rng(seed)
        lens = with_lens_prior(replace(truth, sigma_px=0.01), 0.02).lens
        error_px = linearise(replace(truth, lens=lens)).by_lens @ (0.02 * rng.normal(size=14))
        noise_px = 0.01 * rng.normal(size=truth.observations_px.shape)
        seen = replace(
            truth,
            observations_px=truth.observations_px + error_px + noise_px,
            sigma_px=0.01,
            lens=lens,
        )
        submap = compress(seen, MapName('a', 'a'), seen.point_ids[:8])
        factors.append(submap.a**2 / 0.01**2 / submap.redundancy)
    # The mean of 300 has a standard deviation of 0.006.
    assert np.mean(factors) == pytest.approx(1.0, abs=0.02)


@pytest.fixture(scope='module')
def wrong_calibrations():
    """Fleets in lanes over a yard, every lens wrong by about 0.12 px in each of seven ways."""
    pytest.importorskip('pycolmap', reason='sessions are bundled by Ceres')
    from mapmerge_ros.simulation import FleetConfig, measure, simulate_fleet

    fleets = []
    for seed in range(3):
        rng, fleet = (
            np.random.default_rng(seed),
            simulate_fleet(FleetConfig(descriptors=False), seed),
        )
        robots = []
        for k, truth in enumerate(fleet.truth.bundles):
            lens = with_lens_prior(replace(truth, sigma_px=0.1), 0.12).lens
            error_px = linearise(replace(truth, lens=lens)).by_lens @ (0.12 * rng.normal(size=7))
            seen = replace(truth, observations_px=truth.observations_px + error_px)
            bundle = measure(seen, rng, sigma_px=0.1).bundle
            robots.append((bundle, bundle.point_ids[fleet.shared_rows(k)]))
        fleets.append((fleet, robots))
    return fleets


def merged(fleet, robots, prior_px):
    """Variance factor and root-mean-square error [m] of the merge of a fleet."""
    fusion = fuse(
        [
            compress(
                with_lens_prior(bundle, prior_px),
                MapName(f'drone{k}', f'drone{k}', id_space='fleet'),
                ids,
                catalogue=False,
            )
            for k, (bundle, ids) in enumerate(robots)
        ]
    )
    landmarks = fusion.components[0].landmarks
    truth = fleet.truth.points_world(landmarks.ids)
    placed = align(truth, landmarks.points_global).S_target_source.apply(landmarks.points_global)
    error = np.sqrt(np.mean(np.sum((placed - truth) ** 2, axis=1)))
    return fusion.components[0].verdict.variance_factor, error


def test_wrong_calibrations_merge_honestly_with_nuisance_and_not_without(wrong_calibrations):
    with_nuisance = np.array([merged(*each, 0.12) for each in wrong_calibrations])
    without = np.array([merged(*each, 0.0) for each in wrong_calibrations])
    # 552 degrees of freedom: the factor's own standard deviation is 0.06.
    assert np.abs(with_nuisance[:, 0] - 1.0).max() < 0.15
    assert without[:, 0].min() > 1.25
    assert (with_nuisance[:, 1] < 0.7 * without[:, 1]).all()


def test_rounds_reach_the_full_bundle_that_has_the_same_lenses(wrong_calibrations):
    """Lenses are part of the bundle: re-optimised by the robot, linearised where they are."""
    _, robots = wrong_calibrations[0]
    uncertain = [
        Robot(
            MapName(f'drone{k}', f'drone{k}', id_space='fleet'), with_lens_prior(bundle, 0.12), ids
        )
        for k, (bundle, ids) in enumerate(robots)
    ]
    refined, rounds = refine(uncertain, 4)
    costs = [each.cost_px2 for each in rounds]
    assert all(after <= before for before, after in itertools.pairwise(costs))
    assert abs(costs[-1] / costs[-2] - 1.0) < 1e-9
    assert rounds[-1].step_ratio < 1e-4
    for robot in refined:
        moved_px = robot.bundle.lens.moved_px
        assert 0.01 < np.abs(moved_px).max() < 0.6
        # At the optimum of everything but the landmarks, the prior pulls as much as the images.
        lin = linearise(robot.bundle)
        pull = lin.bundle.lens.weight * lin.bundle.lens.residuals_px
        push = lin.by_lens.reshape(-1, 7).T @ lin.residuals_px.ravel()
        np.testing.assert_allclose(pull, -push, atol=1e-5 * np.abs(push).max())


def test_the_command_says_why_a_lens_is_taken_as_exact(capsys):
    plain = random_bundle(7)
    assert with_uncertain_lens(plain, MapName('a', 'a'), 0.12).lens.size == 14
    assert with_uncertain_lens(plain, MapName('a', 'a'), 0.0).lens.size == 0
    assert not capsys.readouterr().err
    own = replace(
        plain, intrinsics=np.tile(plain.intrinsics[:1], (6, 1)), keyframe_cameras=np.arange(6)
    )
    assert with_uncertain_lens(own, MapName('a/0000', 'a'), 0.12).lens.size == 0
    assert 'a/0000: lens taken as exact: no camera is shared by 3' in capsys.readouterr().err
