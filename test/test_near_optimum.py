# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Statistics of a merge from the fronts against those of the dense inverse."""

import numpy as np
import pytest
from joint_cases import CASES, IDS, case, made_fleets, merged

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from dataclasses import replace

from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.joint.covariance import uncertainty
from mapmerge_ros.fusion.joint.near_optimum import near_optimum
from mapmerge_ros.fusion.local import sensitivity
from mapmerge_ros.fusion.quadratic import quadratic
from mapmerge_ros.geometry import Gauge, gauge_basis
from mapmerge_ros.submap import pack

SIGMA_PX = 0.7


@pytest.fixture(scope='module')
def fleets():
    return made_fleets()


def both(fleets, gauges):
    """The same merge by fronts and by dense algebra."""
    submaps, association, _, cost = case(fleets, gauges)
    reduced = cost.reduced()
    points = merged(submaps, association, cost).points
    gauge = Gauge(int(cost.gauges.min()))
    return (
        near_optimum(reduced, reduced.evaluate(points), gauge, SIGMA_PX),
        quadratic(reduced.elements(), points, gauge, SIGMA_PX),
    )


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_the_quadratic_is_the_plain_one(fleets, gauges):
    found, plain = both(fleets, gauges)
    assert found.price == pytest.approx(plain.price, rel=1e-10)
    assert (found.dof, found.gauges, found.gauge) == (plain.dof, plain.gauges, plain.gauge)
    for name in ('maps', 'rows', 'tracks'):
        np.testing.assert_array_equal(getattr(found.members, name), getattr(plain.members, name))
    np.testing.assert_allclose(
        found.gradient, plain.gradient, atol=1e-9 * np.abs(plain.gradient).max()
    )
    for own, wanted in zip(found.information, plain.information, strict=True):
        np.testing.assert_allclose(own, wanted, atol=1e-10 * np.abs(wanted).max())


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_local_tests_by_fronts_are_those_of_the_dense_inverse(fleets, gauges):
    found, plain = map(sensitivity, both(fleets, gauges))
    for own, wanted in zip(found.within, plain.within, strict=True):
        np.testing.assert_allclose(own, wanted, atol=1e-8 * np.abs(wanted).max())
    tests, expected = found.tests(), plain.tests()
    np.testing.assert_array_equal(tests.distinct, expected.distinct)
    np.testing.assert_allclose(tests.statistic, expected.statistic, rtol=1e-5, atol=1e-6)
    chosen = np.flatnonzero(expected.distinct)[[1, 8, 30]]
    wanted = plain.columns(chosen)
    np.testing.assert_allclose(found.columns(chosen), wanted, atol=1e-8 * np.abs(wanted).max())
    of_one = np.flatnonzero(expected.distinct & (plain.members.maps == 2))[:4]
    np.testing.assert_allclose(found.follow(of_one), plain.follow(of_one), atol=1e-6)
    after, wanted_after = found.unlock(chosen).tests(), plain.unlock(chosen).tests()
    np.testing.assert_allclose(
        after.statistic, wanted_after.statistic, rtol=1e-5, atol=1e-6, equal_nan=True
    )


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_what_comes_by_of_landmarks_and_frames_is_what_is_known_of_them(fleets, gauges):
    submaps, association, _, cost = case(fleets, gauges)
    reduced = cost.reduced()
    state = reduced.evaluate(merged(submaps, association, cost).points)
    gauge, learnt = Gauge(int(cost.gauges.min())), []
    sensitivity(near_optimum(reduced, state, gauge, SIGMA_PX, learnt.append))
    expected = uncertainty(reduced, state, gauge, SIGMA_PX)
    for name in ('landmarks', 'frames'):
        wanted = getattr(expected, name)
        np.testing.assert_allclose(
            getattr(learnt[0], name), wanted, atol=1e-8 * np.abs(wanted).max()
        )
    force = np.random.default_rng(0).normal(size=(state.points.size, 1))
    force -= (basis := gauge_basis(state.points, gauge)) @ (basis.T @ force)
    wanted = expected.factor.solve(force)
    found = learnt[0].factor.solve(force)
    np.testing.assert_allclose(found, wanted, atol=1e-4 * np.abs(wanted).max())


def test_a_landmark_that_nothing_determines_is_said_so(fleets):
    submaps, association, _, cost = case(fleets, CASES[0])
    reduced = cost.reduced()
    points = merged(submaps, association, cost).points
    gone = reduced.tracks == 0
    blind = []
    for k, root in enumerate(reduced.roots):
        r = root.dense()
        r[:, np.repeat(gone[reduced.segments.rows(k)], 3)] = 0.0
        blind.append(replace(root, packed=pack(r)))
    weights = np.where(gone, 0.0, reduced.weights)
    without = replace(reduced, roots=tuple(blind), weights=weights)
    merge = near_optimum(without, without.evaluate(points), Gauge.SIMILARITY, SIGMA_PX)
    with pytest.raises(DegenerateGeometry):
        sensitivity(merge)
