# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How near to its optimum a merge ends: in standard deviations, of whatever follows from it."""

import numpy as np
import pytest
from joint_cases import CASES, CONFIG, IDS, made_fleets
from test_balancing import matrix_of, started

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.fusion.joint import balancing
from mapmerge_ros.fusion.joint import minimise as joint
from mapmerge_ros.fusion.joint.factor import Carried
from mapmerge_ros.fusion.merge import merge
from mapmerge_ros.geometry import Gauge, align

WAYS = ['factor', 'balanced', 'carried', 'dense']


@pytest.fixture(scope='module')
def fleets():
    return made_fleets()


def minimised(cost, points, gauge, config, way, monkeypatch):
    """Landmarks (tracks, 3) from a start, with one kind of matrix only."""
    if way == 'dense':
        return merge(cost.elements(), points, gauge, config).points
    carried = None
    with monkeypatch.context() as context:
        context.setattr(joint, 'pays', lambda _: way == 'balanced')
        context.setattr(balancing, 'STEPS_PER_ROOT', 100.0)  # until it has converged
        if way == 'carried':
            fronts = joint.plan(cost, points)
            elements = joint.gauss_newton(cost, cost.evaluate(points), gauge)
            factor = joint.factorise(fronts, elements, dtype=np.float32)
            carried = Carried(factor, np.arange(cost.count))
        found = joint.minimise(cost, points, gauge, config, carried)
    assert found.converged
    return found.points


def stds_apart(cost, optimum, points, gauge):
    """How far landmarks are from the optimum, in the direction in which that is most."""
    state = cost.evaluate(optimum)
    dof = cost.residual_count - optimum.size + int(gauge)
    difference = (align(optimum, points, gauge=gauge).S_target_source.apply(points)) - optimum
    squared = difference.ravel() @ matrix_of(cost, state) @ difference.ravel()
    return float(np.sqrt(squared / (state.cost / dof)))


@pytest.mark.parametrize('way', WAYS)
@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_a_merge_ends_as_near_as_it_is_told(fleets, gauges, way, monkeypatch):
    cost, points = started(fleets, gauges)
    gauge = Gauge(int(cost.gauges.min()))
    optimum = joint.minimise(cost, points, gauge, CONFIG).points
    far = optimum + 0.01 * np.random.default_rng(0).normal(size=points.shape)
    for convergence in (1e-2, FusionConfig().convergence, 1e-4):
        config = FusionConfig(convergence=convergence)
        found = minimised(cost, far, gauge, config, way, monkeypatch)
        assert stds_apart(cost, optimum, found, gauge) < convergence


def test_nearer_takes_more_steps(fleets):
    cost, points = started(fleets, CASES[0])
    steps = [
        joint.minimise(
            cost, points, Gauge.SIMILARITY, FusionConfig(convergence=convergence)
        ).iterations
        for convergence in (1e-2, 1e-6)
    ]
    assert steps[0] < steps[1]


@pytest.mark.parametrize('value', [0.0, -1e-3, 0.02, float('nan')])
def test_what_is_no_convergence_is_refused(value):
    with pytest.raises(InvalidValue, match='convergence'):
        FusionConfig(convergence=value)


def test_a_step_that_is_rounding_leaves_nothing():
    with np.errstate(all='raise'):
        assert joint._left([3.0, -1e-16]) == 0.0
        assert joint._left([0.0]) == 0.0
