# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Dissection, fronts and their factor, on maps made up for it, against dense algebra."""

import numpy as np
import pytest

from mapmerge_ros.fusion.element import coordinates
from mapmerge_ros.fusion.joint.dissection import OFF_MIDDLE, dissect
from mapmerge_ros.fusion.joint.factor import Change
from mapmerge_ros.fusion.joint.factorise import SMALL, _invert, factorise
from mapmerge_ros.fusion.joint.fronts import plan_fronts


class MadeUp:
    """Random elements on random maps."""

    def __init__(self, rng, count=90, maps=9):
        self.count, self.maps = count, maps
        self.tracks = [np.sort(rng.choice(count, 27, replace=False)) for _ in range(maps)]
        others = np.setdiff1d(np.arange(count), np.concatenate(self.tracks))
        self.tracks[0] = np.union1d(self.tracks[0], others)
        self.roots = [rng.normal(size=(3 * len(own) + 5, 3 * len(own))) for own in self.tracks]
        self.dense = np.zeros((3 * count, 3 * count))
        for own, root in zip(self.tracks, self.roots, strict=True):
            at = coordinates(own)
            self.dense[np.ix_(at, at)] += root.T @ root

    def element(self, k, order, out):
        at = coordinates(order)
        out[...] = (self.roots[k].T @ self.roots[k])[np.ix_(at, at)]

    def fronts(self, seed, last=None):
        places = np.random.default_rng(seed).normal(size=(self.maps, 3))
        owners = np.repeat(np.arange(self.maps), [len(own) for own in self.tracks])
        tree = dissect(places, owners, np.concatenate(self.tracks))
        assert sorted(tree.order) == list(range(self.maps))
        return plan_fronts(tree, self.tracks, self.count, last)


def test_the_factor_solves_and_its_order_does_not_matter():
    """Any tree, any landmarks last, gives the same answer."""
    rng = np.random.default_rng(5)
    made = MadeUp(rng)
    right = rng.normal(size=(3 * made.count, 2))
    inverse = np.linalg.inv(made.dense)
    for seed, last in ((1, None), (2, rng.random(made.count) < 0.4), (3, np.ones(90, bool))):
        factor = factorise(made.fronts(seed, last), made.element)
        np.testing.assert_allclose(factor.solve(right), inverse @ right, atol=1e-9)
        for front, block in factor.inverse_blocks():
            np.testing.assert_allclose(block, inverse[np.ix_(front.rows, front.rows)], atol=1e-9)


@pytest.mark.parametrize('size', [1, SMALL, SMALL + 1, 5 * SMALL + 3])
def test_the_inverse_of_a_factor_by_halves_is_that_of_the_whole(size):
    root = np.random.default_rng(size).normal(size=(2 * size, size))
    matrix = np.asfortranarray(np.tril(root.T @ root))
    wanted = np.linalg.inv(np.linalg.cholesky(root.T @ root))
    matrix[np.triu_indices(size, 1)] = np.nan  # nobody looks there
    _invert(matrix)
    np.testing.assert_allclose(matrix, wanted, atol=1e-9 * np.abs(wanted).max())


def test_a_matrix_that_is_not_definite_in_its_second_half_is_refused():
    matrix = np.asfortranarray(np.diag(np.r_[np.ones(2 * SMALL), -1.0]))
    with pytest.raises(np.linalg.LinAlgError, match='not positive definite'):
        _invert(matrix)


def test_fronts_stay_small_on_a_grid_of_maps():
    """Sixty-four maps in a row share with their neighbours only: no front outgrows three maps."""
    maps = 64
    tracks = [np.arange(10 * k, min(10 * k + 20, 10 * maps)) for k in range(maps)]
    places = np.column_stack([np.arange(maps), np.zeros(maps), np.zeros(maps)])
    owners = np.repeat(np.arange(maps), [len(own) for own in tracks])
    fronts = plan_fronts(dissect(places, owners, np.concatenate(tracks)), tracks, 10 * maps)
    assert max(len(front.rows) for front in fronts.fronts) <= 3 * 40
    assert sum(front.eliminated for front in fronts.fronts) == fronts.size


def test_a_cut_is_the_best_of_all_places_that_are_tried():
    """Maps on a line, links of random weight: the root is cut where the rule says it is best."""
    rng = np.random.default_rng(2)
    maps = 20
    places = np.column_stack([rng.permutation(maps), np.zeros(maps), np.zeros(maps)])
    pairs = np.array([(a, b) for a in range(maps) for b in range(a) if rng.random() < 0.2])
    each = rng.integers(1, 9, len(pairs))
    owners = np.concatenate([np.repeat(pairs[:, side], each) for side in (0, 1)])
    tracks = np.tile(np.arange(each.sum()), 2)
    tree = dissect(places, owners, tracks)
    low, middle, high = tree.spans[-1]
    assert (low, high) == (0, maps)
    by_place = np.argsort(places[:, 0]).tolist()

    def price(part):
        cut = sum(
            count for (a, b), count in zip(pairs, each, strict=True) if (a in part) != (b in part)
        )
        return (1.0 + cut) / (len(part) * (maps - len(part)))

    left = set(tree.order[:middle].tolist())
    assert left in (set(by_place[: len(left)]), set(by_place[-len(left) :]))
    off = int(OFF_MIDDLE * maps)
    prices = [price(set(by_place[:size])) for size in range(maps // 2 - off, maps // 2 + off + 1)]
    assert price(left) == pytest.approx(min(prices))
    assert price(left) < np.median(prices)


def test_rows_of_unequal_length_are_cut_between_rows():
    """Four rows of 5, 4, 4 and 3 maps: the best cut leaves 9 on one side, not 8."""
    rows = [5, 4, 4, 3]
    places = np.array([(x, 2.0 * y, 0.0) for y, count in enumerate(rows) for x in range(count)])
    near = np.linalg.norm(places[:, None] - places[None], axis=2)
    pairs = np.argwhere(np.triu((near > 0.0) & (near < 2.1)))
    weights = np.where(places[pairs[:, 0], 1] == places[pairs[:, 1], 1], 9, 2)
    owners = np.concatenate([np.repeat(pairs[:, side], weights) for side in (0, 1)])
    tree = dissect(places, owners, np.tile(np.arange(weights.sum()), 2))
    _, middle, _ = tree.spans[-1]
    parts = [sorted(part.tolist()) for part in (tree.order[:middle], tree.order[middle:])]
    assert sorted(parts) == [list(range(9)), list(range(9, 16))]


def test_a_changed_element_changes_the_answer_of_the_old_factor():
    """Against dense algebra; all coordinates of the element, and all but some of them."""
    rng = np.random.default_rng(7)
    made = MadeUp(rng)
    fronts, dense = made.fronts(1), made.dense
    factor = factorise(fronts, made.element)
    inverses = {front.leaf: block for front, block in factor.inverse_blocks() if front.leaf >= 0}
    for leaf, part in ((0, slice(None)), (4, slice(6, None))):
        path = fronts.path(leaf)
        front = fronts.fronts[path[0]]
        assert path[-1] == len(fronts.fronts) - 1
        rows = front.rows[part]
        step = rng.normal(size=(len(rows), len(rows)))
        difference = 0.3 * (step + step.T)
        changed = dense.copy()
        changed[np.ix_(rows, rows)] += difference
        through = np.eye(len(rows)) + inverses[leaf][part, part] @ difference
        response = difference @ np.linalg.inv(through)
        change = Change(path, front.places[part], response)
        right = rng.normal(size=(len(dense), 2))
        wanted = np.linalg.solve(changed, right)
        assert np.abs(factor.solve(right) - wanted).max() > 1e-3 * np.abs(wanted).max()
        np.testing.assert_allclose(factor.solve(right, change), wanted, rtol=1e-8, atol=1e-10)
