# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Steps without a factorisation: what they stand for, where they lead, and when they are left."""

from dataclasses import replace

import numpy as np
import pytest
from joint_cases import CASES, CONFIG, IDS, case, made_fleets

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion import fuse
from mapmerge_ros.fusion.joint import balancing
from mapmerge_ros.fusion.joint import minimise as joint
from mapmerge_ros.fusion.joint.balancing import Balanced, balanced, pays
from mapmerge_ros.fusion.joint.banded import Banded
from mapmerge_ros.fusion.joint.start import initial_points
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.overlap import spanning_tree
from mapmerge_ros.geometry import Gauge, Segments, generators
from mapmerge_ros.simulation import FleetConfig, simulate_fleet


@pytest.fixture(scope='module')
def fleets():
    return made_fleets()


def started(fleets, gauges):
    """Shared landmarks of a fleet where its merge starts."""
    submaps, association, _, cost = case(fleets, gauges)
    links = find_links(submaps, association, CONFIG)
    centre, frames = spanning_tree(range(len(cost)), [Gauge(int(g)) for g in cost.gauges], links)
    return cost.reduced(), initial_points(cost.reduced(), frames, centre)


def matrix_of(cost, state):
    """Gauss-Newton matrix, dense."""
    element = joint.gauss_newton(cost, state)
    matrix = np.zeros((3 * cost.count,) * 2)
    for k in range(len(cost)):
        tracks = cost.tracks[cost.segments.rows(k)]
        at = (3 * tracks[:, None] + np.arange(3)).ravel()
        own = np.zeros((len(at),) * 2, order='F')
        element(k, np.arange(len(tracks)), own)
        matrix[np.ix_(at, at)] += np.tril(own) + np.tril(own, -1).T
    return matrix


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_it_is_the_inverse_within_a_factor(fleets, gauges):
    """Eigenvalues of the two together, but for those of the gauge, as the theory says."""
    cost, points = started(fleets, gauges)
    gauge = int(cost.gauges.min())
    state = joint.minimise(cost, points, Gauge(gauge), CONFIG).state
    solver, matrix = balanced(cost, state), matrix_of(cost, state)
    answers = np.array([solver.solve(column) for column in matrix])  # M A, row by row
    # A M A is symmetric where M is.
    both = matrix @ answers.T
    assert np.abs(both - both.T).max() < 1e-4 * np.abs(both).max()
    values = np.sort(np.linalg.eigvals(answers).real)
    assert np.abs(values[:gauge]).max(initial=0.0) < 1e-3
    assert values[gauge] > 0.4
    assert values[-1] < 3.0


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_it_leads_to_the_merge_of_the_factor(fleets, gauges, monkeypatch):
    cost, points = started(fleets, gauges)
    gauge = Gauge(int(cost.gauges.min()))
    by_factor = joint.minimise(cost, points, gauge, CONFIG)
    points = by_factor.points + 0.01 * np.random.default_rng(0).normal(size=points.shape)
    monkeypatch.setattr(joint, 'pays', lambda _: True)
    monkeypatch.setattr(balancing, 'STEPS_PER_ROOT', 100.0)  # never ask whether a factor is faster
    monkeypatch.setattr(joint, 'factorise', None)
    found = joint.minimise(cost, points, gauge, CONFIG)
    assert found.converged
    assert found.iterations <= 25
    assert found.cost == pytest.approx(by_factor.cost, rel=1e-11)
    assert found.matrix is None


def test_a_fleet_is_fused_as_with_a_factor(monkeypatch):
    config = FleetConfig(drones=16, keyframes=12, landmarks=350, descriptors=False)
    submaps = simulate_fleet(config, 1).submaps(catalogue=False)
    with monkeypatch.context() as without:
        without.setattr(joint, 'factorise', None)  # merged without one
        found = fuse(submaps).components[0]
    monkeypatch.setattr(joint, 'pays', lambda _: False)
    wanted = fuse(submaps).components[0]
    assert found.iterations > wanted.iterations
    assert found.map_ids == wanted.map_ids
    assert len(found.map_ids) == len(submaps)
    assert found.verdict.accepted
    assert found.verdict.a_tilde == pytest.approx(wanted.verdict.a_tilde, rel=1e-9)
    apart = np.abs(found.landmarks.points_global - wanted.landmarks.points_global)
    assert (apart < 1e-5 * wanted.landmarks.std).all()


class Useless(Balanced):
    """Steps that do not get on."""

    share = 1.0

    def solve(self, right):
        return self.share * right / np.linalg.norm(right)


@pytest.mark.parametrize('share', [1e-9, -1.0, np.nan, np.inf])
def test_a_factor_is_made_where_it_does_not_get_on(fleets, share, monkeypatch):
    cost, points = started(fleets, CASES[0])
    wanted = joint.minimise(cost, points, Gauge.SIMILARITY, CONFIG)

    def useless(cost, state):
        made = balanced(cost, state)
        fields = {name: getattr(made, name) for name in Balanced.__dataclass_fields__}
        Useless.share = share
        return Useless(**fields)

    monkeypatch.setattr(joint, 'pays', lambda _: True)
    monkeypatch.setattr(joint, 'balanced', useless)
    found = joint.minimise(cost, points, Gauge.SIMILARITY, CONFIG)
    assert found.converged
    assert found.cost == pytest.approx(wanted.cost, rel=1e-11)


def test_a_landmark_that_nobody_determines_is_told(fleets, monkeypatch):
    cost, points = started(fleets, CASES[0])
    monkeypatch.setattr(joint, 'pays', lambda _: True)
    points = points.copy()
    points[0] = np.nan
    with pytest.raises(DegenerateGeometry):
        joint.minimise(cost, points, Gauge.SIMILARITY, CONFIG)


def test_frames_that_others_do_not_determine_are_left_to_the_factor(fleets, monkeypatch):
    """A sub-map with one shared landmark turns freely about it; the cost of the rest is merged."""
    cost, points = started(fleets, CASES[0])
    alone = replace(cost, tracks=np.arange(len(cost.tracks)))  # nobody shares anything
    state = alone.evaluate(points[cost.tracks])
    monkeypatch.setattr(joint, 'pays', lambda _: True)
    with pytest.raises(np.linalg.LinAlgError):
        Banded.of(np.arange(2), np.arange(2), np.zeros((2, 7, 7)), 2)
    assert np.isfinite(state.cost)


def test_it_pays_where_many_sub_maps_share_with_few(fleets):
    cost = started(fleets, CASES[0])[0]
    assert not pays(cost), 'six sub-maps'

    def fleet(maps, landmarks, views):
        """Each sub-map has the landmarks of the next places as well."""
        places = (np.arange(maps)[:, None] + np.arange(views)) % maps
        tracks = (landmarks * places[:, :, None] + np.arange(landmarks)).reshape(maps, -1)
        segments = Segments.of_lengths([tracks.shape[1]] * maps)
        return replace(
            cost,
            roots=(cost.roots[0],) * maps,
            segments=segments,
            tracks=tracks.ravel(),
            points_map=np.random.default_rng(0).normal(size=(tracks.size, 3)),
            weights=np.ones(tracks.size),
            gauges=np.full(maps, 7),
        )

    assert pays(fleet(16, 40, 2))
    assert not pays(fleet(15, 50, 2))
    assert not pays(fleet(16, 20, 2)), 'small ones'
    assert not pays(fleet(640, 5, 2)), 'frames are as many as landmarks'
    assert not pays(fleet(64, 20, 30)), 'everybody shares with everybody'


def test_a_band_is_solved_as_the_dense_matrix_is():
    rng = np.random.default_rng(0)
    count, width = 30, 7
    ring = np.arange(count)
    rows = np.concatenate([ring, ring, (ring + 1) % count])
    columns = np.concatenate([ring, (ring + 1) % count, ring])
    below = 0.3 * rng.normal(size=(count, width, width))
    own = rng.normal(size=(count, width, width))
    own = own @ own.transpose(0, 2, 1) + 5.0 * np.eye(width)
    blocks = np.concatenate([0.5 * own, below, below.transpose(0, 2, 1)])
    # What is given twice is summed.
    rows, columns = np.append(rows, ring), np.append(columns, ring)
    blocks = np.concatenate([blocks, 0.5 * own])
    dense = np.zeros((count, width, count, width))
    for row, column, block in zip(rows, columns, blocks, strict=True):
        dense[row, :, column, :] += block
    dense = dense.reshape(count * width, -1)
    right = rng.normal(size=(count, width))
    banded = Banded.of(rows, columns, blocks, count)
    np.testing.assert_allclose(dense @ banded.solve(right).ravel(), right.ravel(), atol=1e-10)
    assert len(banded.factor) < 0.5 * len(dense), 'no band'
    grown = Banded.of(rows, columns, blocks, count, growth=0.5).solve(right).ravel()
    heavier = dense + 0.5 * np.diag(np.diag(dense))
    np.testing.assert_allclose(heavier @ grown, right.ravel(), atol=1e-10)


def test_landmarks_on_one_line_do_not_turn_about_it(fleets):
    """One motion less, and still a basis: two landmarks are enough for a yaw and a place."""
    cost = started(fleets, CASES[0])[0]
    line = np.zeros(cost.growth.shape)
    line[:, 0] = cost.growth[:, 0]
    columns = np.where(
        (cost.segments.owners == 1)[:, None, None],
        generators(line, Gauge.SIMILARITY),
        generators(cost.growth, Gauge.SIMILARITY),
    )
    basis = balancing._orthonormal(cost, columns)
    for k, squares in enumerate(cost.segments.products(basis, basis)):
        values = np.linalg.eigvalsh(squares)
        np.testing.assert_allclose(values, [float(k != 1), *[1.0] * 6], atol=1e-9)
    # What the columns do, the basis does.
    inner = cost.segments.products(basis, columns)
    np.testing.assert_allclose(basis @ inner[cost.segments.owners], columns, atol=1e-9)
