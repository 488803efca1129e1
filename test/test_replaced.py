# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The factor of an earlier merge with one sub-map replaced, against dense algebra."""

from dataclasses import replace

import numpy as np
import pytest
from joint_cases import CASES, CONFIG, IDS, at_optimum, case, made_fleets

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.joint import resume as resuming
from mapmerge_ros.fusion.joint.covariance import uncertainty
from mapmerge_ros.fusion.joint.factor import Carried
from mapmerge_ros.fusion.joint.minimise import minimise
from mapmerge_ros.fusion.joint.replaced import Member, change, packed, unpacked
from mapmerge_ros.fusion.joint.resume import Members, Resumable, resume
from mapmerge_ros.fusion.joint.root import Root
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
        self.next = with_another(self.cost, REPLACED, keep, rng)
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
    roots = list(cost.roots)
    roots[k] = Root(pack(r), root.c, root.weight, root.columns)
    return replace(
        cost,
        segments=Segments.of_lengths(cost.segments.counts(rows)),
        tracks=cost.tracks[rows],
        points_map=cost.points_map[rows],
        weights=cost.weights[rows],
        information=cost.information[rows],
        is_shared=cost.is_shared[rows],
        roots=tuple(roots),
    )


def of_elements(merge, element, points):
    """Dense matrix of the old merge with that of one map in the place of its own."""
    matrix = np.zeros((points.size, points.size))
    for own, at in [
        *((one, merge.points) for k, one in enumerate(merge.cost.elements()) if k != REPLACED),
        (element, points),
    ]:
        rows = coordinates(own.tracks)
        matrix[np.ix_(rows, rows)] += own.derivatives(own.place(at))[0]
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


def test_a_block_is_packed_and_unpacked():
    block = np.random.default_rng(0).normal(size=(5, 5))
    block += block.T
    triangle = packed(block)
    assert triangle.shape == (15,)
    assert triangle.dtype == np.float32
    np.testing.assert_allclose(unpacked(triangle, 5), block, rtol=1e-6)


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
    roots = list(merge.next.roots)
    roots[4] = replace(roots[4], weight=2.0 * roots[4].weight)
    assert found(cost=replace(merge.next, roots=tuple(roots))) is None
