# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The covariance model of a merge: what it must find, what it must leave alone, what refuses."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from gaussian_merges import draw, merged, noise, scene

from mapmerge_ros.distributions import chi2_tail
from mapmerge_ros.fusion.contrasts import contrasts, matern
from mapmerge_ros.fusion.covariance_model import COARSE_CONTRASTS, TEXTBOOK, fit_model, settled
from mapmerge_ros.fusion.honest import MAX_CONTRASTS, _judged, examine
from mapmerge_ros.fusion.likelihood import step, weigh
from mapmerge_ros.fusion.local import local_tests, sensitivity
from mapmerge_ros.fusion.plausible import MAX_OMEGA_RADII
from mapmerge_ros.fusion.tails import are_gaussian, fit_tails
from mapmerge_ros.geometry import Gauge, generators, scene_radius

NOBODY = np.zeros(0, np.int64)
FREE = np.full(3, np.inf)


def warped(rng, points, members, size):
    """A smooth field over each sub-map, `size` large, (s, 3)."""
    field = np.zeros((len(members), 3))
    for k in range(members.maps.max() + 1):
        part = members.of_map(k)
        correlation = matern(points[members.tracks[part]], 0.7 * scene_radius(points))
        factor = np.linalg.cholesky(correlation + 1e-9 * np.eye(len(correlation)))
        field[part] = size * factor @ rng.normal(size=(len(correlation), 3))
    return field


@pytest.mark.parametrize('gauge', [Gauge.SIMILARITY, Gauge.YAW_TRANSLATION, Gauge.NONE])
def test_contrasts_and_normal_equations_say_the_same(gauge):
    """C P C' = M and C P w = -g: two ways to the local tests, with nothing in common."""
    merge = draw(1, gauge=gauge)
    state, data = sensitivity(merge), contrasts(merge, MAX_CONTRASTS)
    weighing = weigh(data, TEXTBOOK)
    assert data.dof == merge.dof
    np.testing.assert_allclose(weighing.price(data), merge.price, rtol=1e-8)
    np.testing.assert_allclose(data.scores(weighing.weighted), state.score, atol=1e-6)
    blocks, is_seen = weighing.blocks(data)
    assert is_seen[merge.views[merge.members.tracks] > 1].all()
    np.testing.assert_allclose(blocks, state.information(), rtol=1e-6, atol=1e-6)


def test_frames_leave_no_trace_in_the_fit():
    """Every sub-map moved, turned and scaled a little: the same variances."""
    rng = np.random.default_rng(3)
    points, members, matrices = scene(rng, landmarks=80)
    errors = 2.0 * noise(rng, points, members, matrices)
    moved = errors.copy()
    for k in range(4):
        part = members.of_map(k)
        motion = generators(points[members.tracks[part]], Gauge.SIMILARITY)
        moved[part] += motion @ (0.01 * rng.normal(size=7))
    one, other = (
        fit_model(contrasts(merged(points, members, matrices, each), 600), FREE, NOBODY)
        for each in (errors, moved)
    )
    np.testing.assert_allclose(one.model.variances, other.model.variances, atol=1e-5)


def test_variances_are_recovered():
    """φ = 2, τ and ω as large as a typical difference: the mean of 12 fits is within 3 σ."""
    rng, found = np.random.default_rng(4), []
    for _ in range(12):
        points, members, matrices = scene(rng, landmarks=120)
        errors = np.sqrt(2.0) * noise(rng, points, members, matrices)
        unit = contrasts(merged(points, members, matrices, errors), 600).unit
        errors += unit * rng.normal(size=errors.shape)
        errors += warped(rng, points, members, unit)
        data = contrasts(merged(points, members, matrices, errors), 600)
        found.append(
            fit_model(data, FREE, NOBODY).model.variances * [1.0, *[data.unit**2 / unit**2] * 2]
        )
    error = np.std(found, axis=0) / np.sqrt(len(found))
    assert (np.abs(np.mean(found, axis=0) - [2.0, 1.0, 1.0]) < 3.0 * error).all()
    assert (error < [0.15, 0.1, 0.25]).all()


def test_gaussian_noise_needs_no_model():
    """A fit gives φ near 1 and nothing else; an examination does not even prefer it."""
    needed, phi, floor = 0, [], []
    for seed in range(20):
        merge = draw(100 + seed, landmarks=70)
        fitted = fit_model(contrasts(merge, 600), FREE, NOBODY).model
        phi.append(fitted.phi)
        floor.append(fitted.variances[1:].max())
        found = examine(merge, np.inf, certain=True)
        needed += not (found.model is None or found.model.is_textbook)
        assert not found.objects
    assert abs(np.mean(phi) - 1.0) < 0.1
    assert np.median(floor) < 0.1
    assert needed <= 1


def test_what_guards_against_tails_costs_no_power_where_there_are_none():
    """3 of 30 landmarks of one map moved by 6 standard deviations, Gaussian noise, 40 merges."""
    rng, found, false = np.random.default_rng(5), 0, 0
    for _ in range(40):
        points, members, matrices = scene(rng, landmarks=30, views=(3, 4))
        errors = noise(rng, points, members, matrices)
        moved = rng.choice(np.flatnonzero(members.maps == 1), 3, replace=False)
        spread = local_tests(merged(points, members, matrices, errors)).covariance[moved]
        direction = rng.normal(size=(3, 3))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        errors[moved] += 6.0 * np.einsum('sij,sj->si', np.linalg.cholesky(spread), direction)
        merge = merged(points, members, matrices, errors)
        aside = members.tracks[examine(merge, np.inf, certain=True).aside]
        found += np.isin(members.tracks[moved], aside).sum()
        false += (~np.isin(aside, members.tracks[moved])).sum()
    assert found >= 0.95 * 120
    assert false <= 0.01 * 40 * 27


def test_an_object_is_found_before_the_field_can_swallow_it():
    """12 neighbours of one map moved together, over warped maps: those and no others."""
    rng, right = np.random.default_rng(6), 0
    for _ in range(10):
        points, members, matrices = scene(rng, landmarks=120, views=(3, 4))
        errors = noise(rng, points, members, matrices)
        unit = contrasts(merged(points, members, matrices, errors), 600).unit
        errors += warped(rng, points, members, unit)
        own = np.flatnonzero(members.maps == 2)
        centre = points[members.tracks[rng.choice(own)]]
        near = np.argsort(np.linalg.norm(points[members.tracks[own]] - centre, axis=1))
        moved = np.sort(own[near[:12]])
        errors[moved] += 10.0 * unit * np.array([0.6, 0.0, 0.8])
        found = examine(merged(points, members, matrices, errors), np.inf, certain=True)
        named = [each.members for each in found.objects]
        right += len(named) == 1 and len(np.intersect1d(named[0], moved)) >= 11
        assert sum(len(np.setdiff1d(each, moved)) for each in named) <= 2
    assert right >= 9


def test_heavy_tails_are_found_and_their_p_values_mean_what_they_say():
    """Each landmark's errors scaled by a draw of its own: Student's t with 5 degrees."""
    rng, low, count = np.random.default_rng(7), 0, 0
    for _ in range(8):
        points, members, matrices = scene(rng, landmarks=150)
        errors = noise(rng, points, members, matrices)
        errors *= 1.0 / np.sqrt(rng.chisquare(5, len(members)) / 5.0)[:, None]
        found = examine(merged(points, members, matrices, errors), np.inf, certain=True)
        low += (found.tests.p_value[found.tests.distinct] < 0.01).sum()
        count += found.tests.distinct.sum()
        assert found.p_value > 0.01
    assert low <= 0.015 * count


@pytest.mark.parametrize('freedom', [3.0, 6.0])
def test_tails_of_a_known_law(freedom):
    sample = 3.0 * 0.8 * scipy.stats.f.rvs(3, freedom, size=2000, random_state=1)
    assert not are_gaussian(sample, 150.0)
    tails = fit_tails(sample, 150.0)
    assert tails.freedom == pytest.approx(freedom, rel=0.25)
    assert np.mean(tails.p_value(sample) < 0.01) == pytest.approx(0.01, abs=0.006)
    assert are_gaussian(scipy.stats.chi2.rvs(3, size=2000, random_state=1), 150.0)


@pytest.mark.parametrize('damage', ['bent', 'noisy', 'exchanged'])
def test_what_no_plausible_error_explains_is_refused(damage):
    rng = np.random.default_rng(8)
    points, members, matrices = scene(rng, landmarks=120)
    errors = noise(rng, points, members, matrices)
    part = members.of_map(0)
    own = points[members.tracks[part]]
    if damage == 'bent':
        errors[part, 2] += 20.0 * MAX_OMEGA_RADII * own[:, 0] ** 2 / scene_radius(points)
    elif damage == 'noisy':
        errors *= 4.0
    else:
        pair = rng.permutation(len(own))[: len(own) // 5 // 2 * 2].reshape(-1, 2)
        jump = own[pair[:, 1]] - own[pair[:, 0]]
        errors[part.start + pair[:, 0]] += jump
        errors[part.start + pair[:, 1]] -= jump
    found = examine(merged(points, members, matrices, errors), np.inf, certain=True)
    assert found.p_value < 0.01 or found.p_objects < 1e-6


def test_an_excess_that_may_be_a_wrong_basin_is_left_to_the_textbook():
    rng = np.random.default_rng(9)
    points, members, matrices = scene(rng, landmarks=120)
    errors = 1.4 * noise(rng, points, members, matrices)
    merge = merged(points, members, matrices, errors)
    assert examine(merge, np.inf, certain=True).p_value > 0.01
    found = examine(merge, np.inf, certain=False)
    assert found.model is None
    assert found.p_value == pytest.approx(scipy.stats.chi2.sf(merge.price, merge.dof))


def test_the_price_of_a_large_merge_is_that_of_its_own_errors():
    """Fitted to some tracks, tested on all: the last step of the fit has to be on all as well."""
    rng = np.random.default_rng(11)
    for _ in range(2):
        points, members, matrices = scene(rng, landmarks=220, views=(3, 4))
        errors = np.sqrt(1.5) * noise(rng, points, members, matrices)
        unit = contrasts(merged(points, members, matrices, errors), 600).unit
        errors += warped(rng, points, members, unit)
        merge = merged(points, members, matrices, errors)
        assert len(contrasts(merge, MAX_CONTRASTS).tracks) > 2 * COARSE_CONTRASTS
        found = examine(merge, np.inf, certain=True)
        assert found.price == pytest.approx(found.dof, rel=0.01)


@pytest.mark.parametrize('seed', range(20))
def test_variances_go_where_they_are_best_given_those_that_are_stopped(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(5, 3))
    information, variances = root.T @ root, rng.uniform(0.2, 2.0, 3)
    gradient, highest = information @ rng.normal(size=3), np.array([6.0, 1.0, 1.5])
    variances = np.minimum(variances, highest)
    following = step(variances, gradient, information, highest)
    limit = np.minimum(4.0 * variances + 0.1, highest)
    assert (following >= 0.1 * variances - 1e-12).all()
    assert (following <= limit + 1e-12).all()
    inside = (following > 0.1 * variances + 1e-9) & (following < limit - 1e-9)
    left = gradient - information @ (following - variances)
    np.testing.assert_allclose(left[inside], 0.0, atol=1e-6 * np.abs(gradient).max())


@pytest.mark.parametrize('landmarks', [10, 30])
def test_two_maps_with_few_landmarks_may_be_as_wrong_as_honest_maps_are(landmarks):
    """Variances twice what is claimed are plausible, and 36 times are not."""
    plausible = [few(seed, landmarks, np.sqrt(2.0)) for seed in range(20)]
    assert sum(chi2_tail(merge.price, merge.dof) < 0.01 for merge in plausible) >= 5
    assert sum(believed(merge) for merge in plausible) >= 17
    assert not any(believed(few(seed, landmarks, 6.0)) for seed in range(20))
    assert sum(believed(few(seed, landmarks, 1.0)) for seed in range(20)) >= 19


def few(seed, landmarks, factor):
    """Two maps with errors `factor` times what they claim."""
    rng = np.random.default_rng([seed, landmarks])
    points, members, matrices = scene(rng, maps=2, landmarks=landmarks, views=(2, 2))
    return merged(points, members, matrices, factor * noise(rng, points, members, matrices))


def believed(merge):
    found = examine(merge, np.inf, certain=True)
    return min(found.p_value, found.p_objects) >= 0.01 and not found.objects


def test_a_merge_of_which_nothing_is_left_to_test_is_not_refused_for_its_price():
    rng = np.random.default_rng(2)
    points, members, matrices = scene(rng, maps=2, landmarks=12, views=(2, 2))
    data = contrasts(merged(points, members, matrices, noise(rng, points, members, matrices)), 600)
    fitted = settled(data, TEXTBOOK, NOBODY, NOBODY)
    for dof, price in ((0, 0.0), (-2, 5.0)):
        assert _judged(replace(fitted, dof=dof, price=price), np.inf).p_value > 0.1
