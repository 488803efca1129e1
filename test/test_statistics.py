# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Local tests against a dense refit, and their calibration."""

import numpy as np
import pytest
import scipy.stats
from gaussian_merges import draw, merged, noise, scene

from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.conditional import conditional_tests
from mapmerge_ros.fusion.local import forward_selection, local_tests, sensitivity
from mapmerge_ros.geometry import Gauge, gauge_basis

GAUGES = [Gauge.SIMILARITY, Gauge.RIGID, Gauge.YAW_TRANSLATION, Gauge.NONE]


def refit(merge, unlocked):
    """Price with some members given a displacement of their own, and those: plain algebra."""
    size, count = merge.points.size, 3 * len(unlocked)
    hessian, right = np.zeros((size + count, size + count)), np.zeros(size + count)
    for k, matrix in enumerate(merge.information):
        part = merge.members.of_map(k)
        design = np.zeros((len(matrix), size + count))
        for row, track in enumerate(merge.members.tracks[part]):
            design[3 * row : 3 * row + 3, 3 * track : 3 * track + 3] = np.eye(3)
        for slot, member in enumerate(unlocked):
            if part.start <= member < part.stop:
                row = 3 * (member - part.start)
                design[row : row + 3, size + 3 * slot : size + 3 * slot + 3] = np.eye(3)
        hessian += design.T @ matrix @ design
        right += design.T @ merge.gradient[part].ravel()
    null = np.zeros((size + count, int(merge.gauge)))
    null[:size] = gauge_basis(merge.points, merge.gauge)
    step = -np.linalg.solve(hessian + np.diag(hessian).mean() * null @ null.T, right)
    return merge.price + right @ step, step[size:].reshape(-1, 3)


@pytest.mark.parametrize('gauge', GAUGES)
def test_a_statistic_is_the_drop_of_the_price_when_its_member_is_unlocked(gauge):
    merge = draw(1, gauge=gauge)
    tests = local_tests(merge)
    for member in (0, 7, 50, len(merge.members) - 1):
        price, displacement = refit(merge, [member])
        np.testing.assert_allclose(tests.statistic[member], merge.price - price, rtol=1e-7)
        np.testing.assert_allclose(tests.displacement[member], displacement[0], rtol=1e-6)


@pytest.mark.parametrize('gauge', GAUGES)
def test_tests_after_unlocking_are_those_of_the_refit(gauge):
    merge = draw(2, gauge=gauge, views=(2, 3))
    chosen, member = np.array([3, 90, 17]), 60
    state = sensitivity(merge).unlock(chosen[:1]).unlock(chosen[1:])
    before, _ = refit(merge, chosen)
    after, displacements = refit(merge, [*chosen, member])
    tests = state.tests()
    assert state.dof == merge.dof - 9
    np.testing.assert_allclose(state.price, before, rtol=1e-8)
    np.testing.assert_allclose(tests.statistic[member], before - after, rtol=1e-6)
    np.testing.assert_allclose(tests.displacement[member], displacements[-1], rtol=1e-6)


def test_members_that_are_off_are_tested_given_each_other():
    merge = draw(2, views=(2, 4))
    off = np.array([3, 90, 17])
    tests = conditional_tests(sensitivity(merge), off)
    everything, displacements = refit(merge, off)
    np.testing.assert_allclose(tests.displacement[off], displacements, rtol=1e-6)
    for slot, member in enumerate(off):
        without, _ = refit(merge, np.delete(off, slot))
        np.testing.assert_allclose(tests.statistic[member], without - everything, rtol=1e-6)
    other, _ = refit(merge, [*off, 60])
    np.testing.assert_allclose(tests.statistic[60], everything - other, rtol=1e-6)


def test_the_covariance_of_a_displacement_is_that_of_the_refit():
    """The diagonal of the inverse of the refit's normal equations, found by solving for it."""
    rng = np.random.default_rng(3)
    points, members, matrices = scene(rng)
    found = [
        local_tests(merged(points, members, matrices, noise(rng, points, members, matrices)))
        for _ in range(400)
    ]
    spread = np.cov(np.array([tests.displacement[11] for tests in found]).T)
    np.testing.assert_allclose(spread, found[0].covariance[11], rtol=0.35, atol=0.1 * spread.max())


def test_the_twin_of_an_unlocked_landmark_of_two_maps_is_not_tested():
    merge = draw(4, views=(2, 2))
    state = sensitivity(merge).unlock(np.array([5]))
    twin = np.flatnonzero(merge.members.tracks == merge.members.tracks[5])[1]
    tests = state.tests()
    assert not tests.testable[[5, twin]].any()
    assert (tests.p_value[[5, twin]] == 1.0).all()
    assert np.isnan(tests.displacement[twin]).all()
    assert tests.testable.sum() == len(merge.members) - 2
    with pytest.raises(DegenerateGeometry, match='without partner'):
        state.unlock(np.array([twin]))


def test_two_members_of_one_landmark_are_one_test():
    tests = local_tests(draw(5, views=(2, 2)))
    for track in range(60):
        own = np.flatnonzero(tests.members.tracks == track)
        np.testing.assert_allclose(*tests.statistic[own], rtol=1e-6)
        assert tests.distinct[own].tolist() == [True, False]


def test_p_values_are_uniform_when_nothing_moved():
    rng = np.random.default_rng(6)
    p_values = []
    for _ in range(60):
        points, members, matrices = scene(rng, landmarks=40)
        merge = merged(points, members, matrices, noise(rng, points, members, matrices))
        tests = local_tests(merge)
        chosen = np.flatnonzero(tests.distinct)[::7]
        p_values += tests.p_value[chosen].tolist()
    assert scipy.stats.kstest(p_values, 'uniform').pvalue > 0.01


def test_moved_landmarks_are_found_one_after_the_other_and_no_other():
    """5 landmarks of one map moved by 6 standard deviations; 20 merges."""
    rng = np.random.default_rng(7)
    found, false, partners = 0, 0, 0
    for _ in range(20):
        points, members, matrices = scene(rng, views=(3, 4))
        errors = noise(rng, points, members, matrices)
        moved = members.of_map(0).start + np.arange(5)
        typical = local_tests(merged(points, members, matrices, errors)).covariance[moved]
        roots = np.linalg.cholesky(typical)
        directions = rng.normal(size=(5, 3))
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        errors[moved] += 6.0 * np.einsum('sij,sj->si', roots, directions)
        _, chosen = forward_selection(
            sensitivity(merged(points, members, matrices, errors)), level=1e-4
        )
        found += np.isin(moved, chosen).sum()
        others = np.setdiff1d(chosen, moved)
        partners += np.isin(members.tracks[others], members.tracks[moved]).sum()
        false += len(others)
    assert found >= 95
    assert false - partners <= 2
