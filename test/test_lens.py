# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Lens parameters as nuisance: exact elimination, honest merges of wrong calibrations."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import random_bundle

from mapmerge_ros.bundle import (
    Lens,
    MapName,
    compress,
    eliminate,
    linearise,
    with_lens_prior,
)
from mapmerge_ros.bundle.dense import dense_jacobian
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.geometry import Gauge, gauge_basis

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
    size = np.abs(dense.r.T @ dense.r).max()
    np.testing.assert_allclose(fast.r.T @ fast.r / size, dense.r.T @ dense.r / size, atol=1e-8)
    np.testing.assert_allclose(fast.a, dense.a, rtol=1e-8)
    gradient = dense.r.T @ dense.c
    np.testing.assert_allclose(
        fast.r.T @ fast.c, gradient, atol=1e-8 * max(np.abs(gradient).max(), 1)
    )
    size = np.abs(dense.session_by_shared).max()
    np.testing.assert_allclose(
        fast.session_by_shared / size, dense.session_by_shared / size, atol=1e-8
    )
    np.testing.assert_allclose(fast.session_offset, dense.session_offset, atol=1e-8)
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
