# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The factor of an earlier merge with one sub-map replaced, against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from joint_cases import CASES, CONFIG, IDS, at_optimum, case, made_fleets

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.joint import resume as resuming
from mapmerge_ros.fusion.joint.coupling import middle
from mapmerge_ros.fusion.joint.covariance import uncertainty
from mapmerge_ros.fusion.joint.factor import Carried
from mapmerge_ros.fusion.joint.minimise import held_by, minimise
from mapmerge_ros.fusion.joint.near_optimum import near_optimum
from mapmerge_ros.fusion.joint.replaced import Member, change
from mapmerge_ros.fusion.joint.resume import Members, Resumable, resume
from mapmerge_ros.fusion.joint.root import Root
from mapmerge_ros.fusion.local import sensitivity
from mapmerge_ros.geometry import Gauge, Segments, gauge_basis
from mapmerge_ros.submap import pack

NAMES = tuple('abcdef')
REPLACED = 2


@pytest.fixture(scope='module')
def fleets():
    return made_fleets()


class Merge:
    """A merge at its optimum, private landmarks in its factor, and a next one of the same maps."""

    def __init__(self, fleets, gauges):
        submaps, association, _, cost = case(fleets, gauges)
        found, state = at_optimum(submaps, association, cost)
        self.gauge = Gauge(int(cost.gauges.min()))
        self.points, self.cost = found.points, cost.reduced()
        self.numbers = np.flatnonzero(association.views > 1)
        self.factor = uncertainty(cost, state, self.gauge, 0.5).factor
        rng = np.random.default_rng(6)
        seen = np.bincount(self.cost.tracks)[self.cost.tracks[self.cost.segments.rows(REPLACED)]]
        keep = (seen < 3) | (rng.random(len(seen)) < 0.8)  # those that two others have may go
        assert 0 < (~keep).sum() < len(keep)
        self.keep, self.next = keep, with_another(self.cost, REPLACED, keep, rng)
        self.next_points = self.points + 1e-5 * np.abs(self.points).max() * rng.normal(
            size=self.points.shape
        )

    def old(self, **kwargs):
        return replace(Member(self.cost, REPLACED, self.points, self.numbers), **kwargs)

    def new(self, **kwargs):
        return replace(Member(self.next, REPLACED, self.next_points, self.numbers), **kwargs)

    def resumable(self):
        matrix = Carried(self.factor, self.numbers)
        return Resumable(self.members(self.cost), self.points, matrix, self.cost)

    def members(self, cost):
        return Members.of(cost, NAMES, cost.tracks.astype(np.uint64))


def with_another(cost, k, keep, rng):
    """The same cost, but that map k has only some landmarks and its rows of R count otherwise."""
    rows = np.ones(len(cost.tracks), bool)
    rows[cost.segments.rows(k)] = keep
    root = cost.roots[k].without(keep)
    r = rng.uniform(0.5, 1.5, len(root.c))[:, None] * root.dense()
    return replace(
        without_rows(cost, rows),
        roots=changed(cost.roots, k, Root(pack(r), root.c, root.weight, root.columns)),
    )


def changed(roots, k, root):
    return (*roots[:k], root, *roots[k + 1 :])


def without_rows(cost, rows):
    """All but R, which is as it was."""
    return replace(
        cost,
        segments=Segments.of_lengths(cost.segments.counts(rows)),
        tracks=cost.tracks[rows],
        points_map=cost.points_map[rows],
        weights=cost.weights[rows],
        information=cost.information[rows],
        is_shared=cost.is_shared[rows],
    )


def of_elements(merge, element, points):
    """Dense matrix of the old merge with that of one map in the place of its own."""
    others = [one for k, one in enumerate(merge.cost.elements()) if k != REPLACED]
    return sum_of(others, merge.points) + sum_of([element], points)


def sum_of(elements, points):
    matrix = np.zeros((points.size, points.size))
    for element in elements:
        rows = coordinates(element.tracks)
        matrix[np.ix_(rows, rows)] += element.derivatives(element.place(points))[0]
    return matrix


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_the_matrix_of_one_sub_map_is_that_of_its_element(fleets, gauges):
    merge = Merge(fleets, gauges)
    for k in range(len(merge.cost)):
        element = merge.cost.element(k)
        wanted = element.derivatives(element.place(merge.points))[0]
        found = Member(merge.cost, k, merge.points, merge.numbers).matrix
        np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize('gauges', CASES, ids=IDS)
def test_the_changed_factor_is_that_of_the_changed_matrix(fleets, gauges):
    merge = Merge(fleets, gauges)
    matrix = of_elements(merge, merge.next.element(REPLACED), merge.next_points)
    null = gauge_basis(merge.points, merge.gauge)
    wanted = np.random.default_rng(3).normal(size=merge.points.size)
    wanted -= null @ (null.T @ wanted)

    def error(carried):
        solved = carried.solve(matrix @ wanted)
        solved -= null @ (null.T @ solved)
        return np.abs(solved - wanted).max() / np.abs(wanted).max()

    found = change(merge.factor, merge.old(), merge.new())
    assert error(Carried(merge.factor, merge.numbers)) > 0.3
    assert error(Carried(merge.factor, merge.numbers, found)) < 0.02


def test_a_landmark_that_only_the_new_sub_map_has_is_left_out(fleets):
    """The other way round: the matrix of the new one without its rows and columns."""
    merge = Merge(fleets, CASES[0])
    old = Member(merge.next, REPLACED, merge.points, merge.numbers)
    new = Member(merge.cost, REPLACED, merge.points, merge.numbers)
    # A factor of the maps of `next`, made as that of the merge was.
    state = merge.next.evaluate(merge.points)
    factor = uncertainty(merge.next, state, merge.gauge, 0.5).factor
    numbers = np.arange(len(merge.points))
    old, new = (replace(one, numbers=numbers) for one in (old, new))
    found = change(factor, old, new)
    rows = coordinates(merge.next.tracks[merge.next.segments.rows(REPLACED)])
    matrix = sum_of(merge.next.elements(), merge.points)
    at = coordinates(np.flatnonzero(merge.keep))
    matrix[np.ix_(rows, rows)] += new.matrix[np.ix_(at, at)] - old.matrix
    # Cut out of a matrix, a part of it does hold the frame: what the factor adds for that counts.
    matrix += hold(merge.next, state, merge.gauge)
    wanted = np.random.default_rng(3).normal(size=merge.points.size)
    solved = Carried(factor, numbers, found).solve(matrix @ wanted)
    np.testing.assert_allclose(solved, wanted, atol=0.02 * np.abs(wanted).max())


def hold(cost, state, gauge):
    """What a factor has beside the elements (size, size): the frame of the whole is held."""
    k = middle(cost, state.points)
    element = cost.element(k)
    own = np.asfortranarray(element.derivatives(element.place(state.points))[0])
    held = own.copy(order='F')
    held_by(cost, state, gauge, k, np.arange(len(element.tracks)), held)
    lower = np.tril(held - own)
    matrix = np.zeros((state.points.size, state.points.size))
    at = coordinates(element.tracks)
    matrix[np.ix_(at, at)] = lower + np.tril(lower, -1).T
    return matrix


def test_what_all_sub_maps_count_is_taken_out(fleets, monkeypatch):
    """Pooled noise scales every matrix: with that of one sub-map replaced, and without."""
    monkeypatch.setattr(resuming, 'HIGHEST_PRICE', np.inf)
    merge = Merge(fleets, CASES[0])
    for cost in (merge.next, merge.cost):
        heavier = scaled(cost, 3.0)
        plain = resume(cost, merge.members(cost), merge.resumable()).matrix
        found = resume(heavier, merge.members(cost), merge.resumable()).matrix
        assert found.scale == pytest.approx(3.0)
        assert (found.change is None) == (plain.change is None) == (cost is merge.cost)
        right = np.random.default_rng(2).normal(size=merge.points.size)
        wanted = plain.solve(right) / 3.0
        np.testing.assert_allclose(
            found.solve(right), wanted, rtol=1e-3, atol=1e-3 * np.abs(wanted).max()
        )
        wobbling = tuple(
            replace(root, weight=root.weight * (1.0 + (k % 3 - 1) * 4e-16))
            for k, root in enumerate(cost.roots)
        )
        again = resume(replace(cost, roots=wobbling), merge.members(cost), merge.resumable())
        assert (again.matrix.change is None) == (cost is merge.cost)


def scaled(cost, factor):
    roots = tuple(replace(root, weight=factor * root.weight) for root in cost.roots)
    return replace(cost, roots=roots, information=factor * cost.information)


@pytest.mark.parametrize('sigma', [0.5, 1e-77])
def test_blocks_that_come_by_are_those_of_the_factor(fleets, sigma):
    """Whatever the noise is taken to be: without any it is next to nothing."""
    merge = Merge(fleets, CASES[0])
    state, learnt = merge.cost.evaluate(merge.points), []
    sensitivity(near_optimum(merge.cost, state, merge.gauge, sigma, learnt.append))
    wanted = uncertainty(merge.cost, state, merge.gauge, sigma).factor.leaves
    found = learnt[0].factor.leaves
    assert set(found) == set(wanted) == set(range(len(merge.cost)))
    for k, block in wanted.items():
        np.testing.assert_allclose(found[k], block, atol=1e-4 * np.abs(block).max())
    # With private landmarks in the factor, the blocks are those of the shared ones.
    for k, block in merge.factor.leaves.items():
        own = 3 * merge.cost.segments.lengths[k]
        assert len(block) == own * (own + 1) // 2


@pytest.mark.parametrize('weight', [1e-8, 1e3, 1e5, 1e8])
def test_a_sub_map_that_counts_otherwise_by_orders_is_no_wrong_merge(fleets, monkeypatch, weight):
    """Where float32 has too few digits for it there is no change; the optimum is the same."""
    monkeypatch.setattr(resuming, 'HIGHEST_PRICE', np.inf)
    merge = Merge(fleets, CASES[0])
    root = merge.next.roots[REPLACED]
    roots = changed(merge.next.roots, REPLACED, replace(root, weight=weight * root.weight))
    cost = replace(merge.next, roots=roots)
    start = resume(cost, merge.members(cost), merge.resumable())
    found = minimise(cost, merge.points, merge.gauge, CONFIG, start.matrix)
    wanted = minimise(cost, merge.points, merge.gauge, CONFIG)
    # Where the old factor is of no use any more the merge says so, and another start follows.
    assert found.cost <= wanted.cost * (1.0 + 1e-6) if found.converged else weight > 1e3


def test_a_factor_that_promises_to_raise_the_cost_is_made_anew(fleets):
    merge = Merge(fleets, CASES[0])
    found = change(merge.factor, merge.old(), merge.new())
    wild = replace(found, response=-1e6 * np.abs(found.response).max() * np.eye(len(found.places)))
    for response in (wild.response, -wild.response, np.full(wild.response.shape, np.nan)):
        carried = Carried(merge.factor, merge.numbers, replace(wild, response=response))
        merged = minimise(merge.next, merge.next_points, merge.gauge, CONFIG, carried)
        wanted = minimise(merge.next, merge.next_points, merge.gauge, CONFIG)
        assert merged.converged
        assert merged.cost == pytest.approx(wanted.cost, rel=1e-9)


def test_what_cannot_be_changed_is_left_to_the_merge(fleets, monkeypatch):
    monkeypatch.setattr(resuming, 'HIGHEST_PRICE', np.inf)
    merge = Merge(fleets, CASES[0])
    for error in (DegenerateGeometry('no frame'), np.linalg.LinAlgError('singular')):

        def fails(*_, error=error):
            raise error

        monkeypatch.setattr(resuming, 'change', fails)
        start = resume(merge.next, merge.members(merge.next), merge.resumable())
        assert start.matrix.change is None


def test_no_change_without_the_block_or_where_a_landmark_is_gone(fleets):
    merge = Merge(fleets, CASES[0])
    assert change(merge.factor, merge.old(), merge.new()) is not None
    assert change(replace(merge.factor, leaves={}), merge.old(), merge.new()) is None
    numbers = merge.numbers.copy()
    numbers[merge.cost.tracks[merge.cost.segments.rows(REPLACED)][0]] = 10**6
    assert change(merge.factor, merge.old(), merge.new(numbers=numbers)) is None


def test_a_merge_with_one_sub_map_replaced_goes_on_as_if_its_factor_were_new(fleets, monkeypatch):
    """As many steps as with the factor of the new maps, where the old one takes more."""
    monkeypatch.setattr(resuming, 'HIGHEST_PRICE', np.inf)
    merge = Merge(fleets, CASES[0])
    start = resume(merge.next, merge.members(merge.next), merge.resumable())
    assert start is not None
    assert start.matrix.change is not None
    steps = {
        name: minimise(merge.next, merge.points, merge.gauge, CONFIG, carried)
        for name, carried in (
            ('changed', start.matrix),
            ('old', replace(start.matrix, change=None)),
            ('new', None),
        )
    }
    assert steps['changed'].cost == pytest.approx(steps['new'].cost, rel=1e-10)
    assert steps['changed'].iterations <= steps['new'].iterations + 1
    assert steps['changed'].iterations < steps['old'].iterations


def test_only_one_sub_map_is_changed_and_only_where_it_pays(fleets, monkeypatch):
    merge = Merge(fleets, CASES[0])
    members, last = merge.members(merge.next), merge.resumable()

    def found(cost=merge.next, last=last):
        return resume(cost, members, last).matrix.change

    assert found() is None  # six small maps: two steps cost less
    monkeypatch.setattr(resuming, 'HIGHEST_PRICE', np.inf)
    assert found() is not None
    assert found(last=replace(last, cost=None)) is None
    assert resume(merge.cost, merge.members(merge.cost), last).matrix.change is None
    root = merge.next.roots[4]
    both = changed(merge.next.roots, 4, replace(root, weight=2.0 * root.weight))
    assert found(cost=replace(merge.next, roots=both)) is None
