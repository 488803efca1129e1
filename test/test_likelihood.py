# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The likelihood of the differences, and what is taken out of it, against plain formulas."""

import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from gaussian_merges import draw

from mapmerge_ros.fusion.contrasts import contrasts
from mapmerge_ros.fusion.honest import MAX_CONTRASTS
from mapmerge_ros.fusion.likelihood import (
    LOG_PHI_STD,
    USUAL_PHI,
    derivatives,
    log_likelihood,
    weigh,
    with_usual_phi,
)
from mapmerge_ros.geometry import Gauge

NOBODY = np.zeros(0, np.int64)


def test_the_gradient_of_the_likelihood_is_right():
    data = contrasts(draw(2), MAX_CONTRASTS)
    at = np.array([1.3, 0.4, 0.2])
    gradient, information = derivatives(data, weigh(data, at))
    for k in range(3):
        ahead, back = (weigh(data, at + sign * 1e-4 * np.eye(3)[k]) for sign in (1, -1))
        slope = (ahead.log_likelihood - back.log_likelihood) / 2e-4
        np.testing.assert_allclose(gradient[k], slope, rtol=1e-4)
    assert (np.linalg.eigvalsh(information) > 0.0).all()


def test_what_is_known_of_phi_is_a_gaussian_of_its_logarithm():
    law = scipy.stats.norm(np.log(USUAL_PHI), LOG_PHI_STD)
    for phi in (0.1, 0.6, 2.5):
        gradient, information = with_usual_phi(np.array([phi, 0.3, 0.1]), np.ones(3), np.eye(3))
        ahead, back = (law.logpdf(np.log(phi + step)) for step in (1e-6, -1e-6))
        np.testing.assert_allclose(gradient, [1.0 + (ahead - back) / 2e-6, 1.0, 1.0], rtol=1e-6)
        np.testing.assert_allclose(information[0, 0], 1.0 + 1.0 / (LOG_PHI_STD * phi) ** 2)
        np.testing.assert_array_equal(information[1:], np.eye(3)[1:])


@pytest.mark.parametrize('gauge', [Gauge.SIMILARITY, Gauge.NONE])
def test_who_is_unlocked_is_explained_as_frames_are(gauge):
    """Projected, or the inverse covariance of what neither frames nor members can explain."""
    data, at = contrasts(draw(2, gauge=gauge), MAX_CONTRASTS), np.array([1.3, 0.4, 0.2])
    members = np.array([3, 17, 40])
    blind = data.blind_to(members)
    unlocked, frames = weigh(data, at).unlocked(data, members), weigh(blind, at)
    seen = scipy.linalg.null_space(blind.frames.T)
    precision = seen @ np.linalg.solve(seen.T @ data.covariance(at) @ seen, seen.T)
    for weighing in (unlocked, frames):
        np.testing.assert_allclose(
            weighing.seen(np.eye(len(precision))), precision, atol=1e-9 * np.abs(precision).max()
        )
        np.testing.assert_allclose(weighing.weighted, precision @ data.differences, rtol=1e-7)
    some = data.columns(np.arange(20, 30))
    own = (some.T @ precision @ some).reshape(10, 3, 10, 3)[np.arange(10), :, np.arange(10)]
    np.testing.assert_allclose(
        unlocked.blocks(data)[0][20:30], own, atol=1e-9 * np.abs(precision).max()
    )
    for found, expected in zip(
        derivatives(data, unlocked), derivatives(blind, frames), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-7)
    gradient = 0.5 * (data.parts(unlocked.weighted) @ unlocked.weighted - data.traces(precision))
    np.testing.assert_allclose(derivatives(data, unlocked)[0], gradient, rtol=1e-7)


@pytest.mark.parametrize('gauge', [Gauge.SIMILARITY, Gauge.NONE])
@pytest.mark.parametrize('unlocked', [NOBODY, np.array([3, 17, 40])])
def test_the_likelihood_needs_no_inverse(gauge, unlocked):
    data, at = contrasts(draw(2, gauge=gauge), MAX_CONTRASTS), np.array([1.3, 0.4, 0.2])
    expected = weigh(data, at).unlocked(data, unlocked).log_likelihood
    assert log_likelihood(data, at, unlocked) == pytest.approx(expected, rel=1e-10)
