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
from mapmerge_ros.fusion.joint.cost import JointCost
from mapmerge_ros.fusion.joint.start import initial_points
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.overlap import spanning_tree
from mapmerge_ros.geometry import Gauge, Segments, generators
from mapmerge_ros.simulation import FleetConfig, simulate_fleet
from mapmerge_ros.submap import pack, triangulate


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


def assert_is_inverse_within_a_factor(cost, state, tolerance=1e-4):
    solver, matrix = balanced(cost, state), matrix_of(cost, state)
    answers = np.array([solver.solve(column) for column in matrix])  # M A, row by row
    # A M A is symmetric where M is.
    both = matrix @ answers.T
    assert np.abs(both - both.T).max() < tolerance * np.abs(both).max()
    values = np.sort(np.linalg.eigvals(answers).real)
    gauge = int(cost.gauges.min())
    assert np.abs(values[:gauge]).max(initial=0.0) < tolerance * 10.0
    assert values[gauge] > 0.55
    assert values[-1] < 2.1


def reordered(cost, orders):
    """The same knowledge with the landmarks of each sub-map in another order."""
    roots = []
    for k, order in enumerate(orders):
        at = (3 * order[:, None] + np.arange(3)).ravel()
        r, c = triangulate(cost.roots[k].dense()[:, at], cost.roots[k].c)
        roots.append(replace(cost.roots[k], packed=pack(r), c=c))
    rows = np.concatenate(
        [start + order for start, order in zip(cost.segments.ends[:-1], orders, strict=True)]
    )
    names = 'tracks', 'points_map', 'weights', 'information', 'is_shared'
    return replace(cost, roots=tuple(roots), **{name: getattr(cost, name)[rows] for name in names})


def repeated(cost, times):
    """Every sub-map so many times."""
    names = 'gauges', 'tracks', 'points_map', 'weights', 'information', 'is_shared'
    return replace(
        cost,
        segments=Segments.of_lengths([*cost.segments.lengths] * times),
        roots=cost.roots * times,
        **{name: np.concatenate([getattr(cost, name)] * times) for name in names},
    )


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_it_is_the_inverse_within_a_factor(fleets, gauges):
    """Eigenvalues of the two together, but for those of the gauge, as the theory says."""
    cost, points = started(fleets, gauges)
    gauge = int(cost.gauges.min())
    state = joint.minimise(cost, points, Gauge(gauge), CONFIG).state
    assert_is_inverse_within_a_factor(cost, state)


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_it_does_not_matter_which_landmarks_come_last(fleets, gauges):
    """Neighbours in the image: R says next to nothing of all others with these two held."""
    cost, points = started(fleets, gauges)
    points = joint.minimise(cost, points, Gauge(int(cost.gauges.min())), CONFIG).points
    orders = []
    for k in range(len(cost)):
        own = points[cost.tracks[cost.segments.rows(k)]]
        apart = np.linalg.norm(own[:, None] - own, axis=2) + np.diag(np.full(len(own), np.inf))
        pair = np.array(np.unravel_index(np.argmin(apart), apart.shape))
        orders.append(np.concatenate([np.setdiff1d(np.arange(len(own)), pair), pair]))
    other = reordered(cost, orders)
    assert_is_inverse_within_a_factor(other, other.evaluate(points), tolerance=1e-2)


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_maps_that_know_the_same_share_their_motions(fleets, gauges):
    cost, points = started(fleets, gauges)
    points = joint.minimise(cost, points, Gauge(int(cost.gauges.min())), CONFIG).points
    twins = repeated(cost, 2)
    assert_is_inverse_within_a_factor(twins, twins.evaluate(points))


def test_what_is_kept_of_neighbours_is_no_more_than_what_came(fleets):
    cost, points = started(fleets, CASES[0])
    crowd = repeated(cost, 8)
    assert balanced(crowd, crowd.evaluate(points)) is None


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
        found = fuse(submaps, CONFIG).components[0]
    monkeypatch.setattr(joint, 'pays', lambda _: False)
    wanted = fuse(submaps, CONFIG).components[0]
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
    assert found.matrix is not None, 'no factor'


def refuses(cost, state):
    raise np.linalg.LinAlgError('frames that the others do not determine')


@pytest.mark.parametrize(
    'none', [refuses, lambda cost, state: None], ids=['singular', 'too large']
)
def test_a_factor_is_made_where_there_are_no_balanced_steps(fleets, none, monkeypatch):
    cost, points = started(fleets, CASES[0])
    wanted = joint.minimise(cost, points, Gauge.SIMILARITY, CONFIG)
    monkeypatch.setattr(joint, 'pays', lambda _: True)
    monkeypatch.setattr(joint, 'balanced', none)
    found = joint.minimise(cost, points, Gauge.SIMILARITY, CONFIG)
    assert found.history == wanted.history
    assert found.matrix is not None


def test_a_step_to_where_frames_are_undetermined_is_not_taken(fleets, monkeypatch):
    cost, points = started(fleets, CASES[0])
    wanted = joint.minimise(cost, points, Gauge.SIMILARITY, CONFIG)
    evaluate, calls = JointCost.evaluate, []

    def second_one_fails(self, points):
        calls.append(points)
        if len(calls) == 2:
            raise DegenerateGeometry('all landmarks in one place')
        return evaluate(self, points)

    monkeypatch.setattr(joint, 'pays', lambda _: True)
    monkeypatch.setattr(JointCost, 'evaluate', second_one_fails)
    found = joint.minimise(cost, points, Gauge.SIMILARITY, CONFIG)
    assert found.converged
    assert found.matrix is not None, 'no factor'
    assert found.cost == pytest.approx(wanted.cost, rel=1e-11)


def test_a_factor_that_was_outdated_is_not_handed_on(fleets, monkeypatch):
    cost, points = started(fleets, CASES[0])
    last = joint.minimise(cost, points, Gauge.SIMILARITY, CONFIG)
    assert joint.minimise(cost, last.points, Gauge.SIMILARITY, CONFIG, last.matrix).matrix is (
        last.matrix
    )
    monkeypatch.setattr(joint, 'pays', lambda _: True)
    monkeypatch.setattr(balancing, 'STEPS_PER_ROOT', 100.0)
    far = last.points + 0.3 * np.random.default_rng(0).normal(size=points.shape)
    found = joint.minimise(cost, far, Gauge.SIMILARITY, CONFIG, last.matrix)
    assert found.converged
    assert found.matrix is not last.matrix


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


def test_landmarks_on_one_line_do_not_turn_about_it(fleets):
    """One motion less, and still a basis: two landmarks are enough for a yaw and a place."""
    cost = started(fleets, CASES[0])[0]
    line = np.zeros(cost.growth.shape)
    line[:, 0] = cost.growth[:, 0]
    line[:, 1:] = 1e-16 * cost.growth[:, 1:]  # what rounding leaves of a line
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
