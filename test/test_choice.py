# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which landmarks to ask for: within the budget, holding the fleet, all over it, in any order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from catalogues import SCENE, catalogue, tracks_by_id, within
from scenes import random_bundle
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree

from mapmerge_ros.arrays import Ids
from mapmerge_ros.bundle import MapName, announce
from mapmerge_ros.fusion import FusionConfig
from mapmerge_ros.fusion.catalogues import ALONE, Tracks
from mapmerge_ros.fusion.choice import ENOUGH, _Selection, choose_landmarks
from mapmerge_ros.fusion.offline import choose_for_bundles
from mapmerge_ros.fusion.requests import plan_requests
from mapmerge_ros.submap import SubMap


def random_fleet(seed: int) -> list[SubMap]:
    """Sub-maps of random rectangles of the scene, each with part of the points."""
    rng = np.random.default_rng(seed)
    fleet = []
    for k in range(int(rng.integers(2, 9))):
        low = rng.uniform([0, 0], [70, 40])
        ids = within(low, low + rng.uniform(10, 45, 2), rng.uniform(0.2, 1.0), seed=seed + k)
        fleet.append(catalogue(f'drone{k}/0001', rng.permutation(ids), seed=seed))
    return fleet


def promised_shares(fleet: Sequence[SubMap], budgets: Sequence[int]) -> dict[tuple[int, int], int]:
    """What each pair of the maximum spanning forest is promised."""
    common = np.array(
        [[len(np.intersect1d(a.landmark_ids, b.landmark_ids)) for b in fleet] for a in fleet]
    )
    np.fill_diagonal(common, 0)
    # The fleet is in order of its names, so that ties are broken as in the choice itself.
    tree = minimum_spanning_tree(-common).toarray() < 0
    forest = tree | tree.T
    share = np.asarray(budgets) // np.maximum(forest.sum(axis=1), 1)
    return {
        (int(a), int(b)): int(min(common[a, b], share[a], share[b], ENOUGH))
        for a, b in np.argwhere(np.triu(forest))
    }


@pytest.mark.parametrize('seed', range(30))
def test_budgets_are_kept_and_no_pair_is_starved(seed: int) -> None:
    fleet = random_fleet(seed)
    budgets = [int(x) for x in np.random.default_rng(seed).integers(0, 120, len(fleet))]
    chosen = choose_landmarks(fleet, tracks_by_id(fleet), budgets)
    for submap, ids, budget in zip(fleet, chosen, budgets, strict=True):
        assert len(ids) <= budget
        assert len(np.unique(ids)) == len(ids)
        assert np.isin(ids, submap.landmark_ids).all()
    for (a, b), promised in promised_shares(fleet, budgets).items():
        assert len(np.intersect1d(chosen[a], chosen[b])) >= promised
    asked, views = np.unique(np.concatenate(chosen), return_counts=True)
    assert (views >= 2).all(), asked[views < 2]


@pytest.mark.parametrize('seed', range(8))
def test_room_is_used_up_while_there_is_something_to_share(seed: int) -> None:
    fleet = random_fleet(seed)
    chosen = choose_landmarks(fleet, tracks_by_id(fleet), [10_000] * len(fleet))
    everything = np.concatenate([submap.landmark_ids for submap in fleet])
    ids, views = np.unique(everything, return_counts=True)
    for submap, own in zip(fleet, chosen, strict=True):
        shared = np.intersect1d(submap.landmark_ids, ids[views >= 2])
        np.testing.assert_array_equal(np.sort(own), shared)


@pytest.mark.parametrize('seed', range(8))
def test_no_order_and_no_numbering_leaves_a_trace(seed: int) -> None:
    fleet, rng = random_fleet(seed), np.random.default_rng(seed)
    chosen = choose_landmarks(fleet, tracks_by_id(fleet), [60] * len(fleet))
    order = rng.permutation(len(fleet))
    shuffled = [
        catalogue_like(fleet[k], rng.permutation(len(fleet[k].landmark_ids))) for k in order
    ]
    tracks = tracks_by_id(shuffled)
    numbers = rng.permutation(tracks.count)
    renumbered = Tracks(tuple(numbers[own] for own in tracks.tracks), tracks.count)
    again = choose_landmarks(shuffled, renumbered, [60] * len(fleet))
    for place, k in enumerate(order):
        np.testing.assert_array_equal(again[place], chosen[k])


def catalogue_like(submap: SubMap, rows: Ids) -> SubMap:
    """The same catalogue, its landmarks in another order."""
    assert submap.covariances is not None
    return replace(
        submap,
        landmark_ids=submap.landmark_ids[rows],
        points=submap.points[rows],
        covariances=submap.covariances[rows],
    )


def test_no_frame_and_no_scale_leaves_a_trace() -> None:
    fleet = random_fleet(3)
    moved = [catalogue(x.map_id, x.landmark_ids, seed=99, covariances=None) for x in fleet]
    unmoved = [catalogue(x.map_id, x.landmark_ids, seed=3, covariances=None) for x in fleet]
    first = choose_landmarks(unmoved, tracks_by_id(unmoved), [60] * len(fleet))
    second = choose_landmarks(moved, tracks_by_id(moved), [60] * len(fleet))
    for own, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(own, other)


def mean_square_gap(ids: Ids, shared: Ids) -> float:
    """Mean square distance of the common points to the nearest chosen one [m²]."""
    chosen, wanted = SCENE[ids.astype(np.int64)], SCENE[shared.astype(np.int64)]
    return float(np.mean(cKDTree(chosen).query(wanted)[0] ** 2))


class Plainly(_Selection):
    """The same greedy choice with every value made anew for every step."""

    def _cover(self) -> None:
        turn = 1.0
        while queue := self._queue():
            self._take(self._takers(queue[0][1]), turn)
            turn += 1.0


@pytest.mark.parametrize('seed', range(12))
def test_values_that_are_not_made_anew_are_those_that_cannot_have_risen(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map that is full raises what others gain from what they share with it."""
    fleet = random_fleet(seed)
    budgets = [int(x) for x in np.random.default_rng(seed).integers(10, 90, len(fleet))]
    chosen = choose_landmarks(fleet, tracks_by_id(fleet), budgets)
    monkeypatch.setattr('mapmerge_ros.fusion.choice._Selection', Plainly)
    plainly = choose_landmarks(fleet, tracks_by_id(fleet), budgets)
    for own, other in zip(chosen, plainly, strict=True):
        assert set(own.tolist()) == set(other.tolist())


def test_the_choice_is_spread_better_than_chance() -> None:
    a = catalogue('a', within([0, 0], [60, 60]))
    b = catalogue('b', within([40, 0], [100, 60]))
    shared = np.intersect1d(a.landmark_ids, b.landmark_ids)
    rng = np.random.default_rng(0)
    for budget in (10, 30, 100):
        chosen = choose_landmarks([a, b], tracks_by_id([a, b]), [budget] * 2)
        assert set(chosen[0]) == set(chosen[1])
        by_chance = [mean_square_gap(rng.choice(shared, budget, False), shared) for _ in range(50)]
        assert mean_square_gap(chosen[0], shared) < 0.85 * np.median(by_chance)


def test_the_sure_are_preferred() -> None:
    ids = within([0, 0], [100, 60], 0.3)
    fleet = [catalogue('a', ids, seed=1), catalogue('b', ids, seed=2)]
    chosen = choose_landmarks(fleet, tracks_by_id(fleet), [100] * 2)
    for submap, own in zip(fleet, chosen, strict=True):
        assert submap.covariances is not None
        variances = submap.covariances[:, 0]
        is_chosen = np.isin(submap.landmark_ids, own)
        assert np.median(variances[is_chosen]) < 0.8 * np.median(variances[~is_chosen])


def test_what_many_have_is_preferred() -> None:
    everywhere = within([0, 0], [100, 60], 0.05, seed=1)
    fleet = [
        catalogue(f'd{k}', np.union1d(everywhere, within([0, 0], [100, 60], 0.3, seed=k + 2)))
        for k in range(4)
    ]
    chosen = choose_landmarks(fleet, tracks_by_id(fleet), [60] * 4)
    views = np.bincount(np.concatenate([x.landmark_ids for x in fleet]).astype(np.int64))
    mean_views = np.mean([views[own.astype(np.int64)].mean() for own in chosen])
    offered = np.mean([views[x.landmark_ids.astype(np.int64)].mean() for x in fleet])
    assert mean_views > offered + 0.5


@pytest.mark.parametrize('seed', range(8))
def test_half_of_what_was_asked_holds_the_fleet_too(seed: int) -> None:
    """A robot that drops from the end to save bytes leaves nobody alone."""
    fleet = random_fleet(seed)
    budgets = [80] * len(fleet)
    chosen = choose_landmarks(fleet, tracks_by_id(fleet), budgets)
    halves = [ids[: len(ids) // 2] for ids in chosen]
    for (a, b), promised in promised_shares(fleet, budgets).items():
        assert len(np.intersect1d(halves[a], halves[b])) >= 0.25 * promised - 1


def test_pairs_with_too_little_in_common_get_nothing() -> None:
    a, b, c = (
        catalogue('a', range(0, 50)),
        catalogue('b', range(30, 80)),
        catalogue('c', range(77, 120)),
    )
    fleet = [a, b, c]
    chosen = choose_landmarks(fleet, tracks_by_id(fleet), [100] * 3, min_shared=4)
    assert [len(ids) for ids in chosen] == [20, 20, 0]


def test_landmarks_that_are_alone_are_not_asked_for() -> None:
    fleet = [catalogue('a', range(20)), catalogue('b', range(20))]
    own = np.arange(20)
    alone = np.where(own < 5, ALONE, own)
    chosen = choose_landmarks(fleet, Tracks((alone, own), 20), [100, 100])
    assert set(chosen[0]) == set(chosen[1]) == set(range(5, 20))
    assert [len(x) for x in choose_landmarks([], Tracks((), 0), [])] == []
    assert [len(x) for x in choose_landmarks(fleet[:1], Tracks((own,), 20), [9])] == [0]


def test_a_track_with_two_members_in_one_map_counts_once() -> None:
    fleet = [catalogue('a', range(10)), catalogue('b', range(10))]
    own = np.arange(10)
    twice = np.where(own == 1, 0, own)
    chosen = choose_landmarks(fleet, Tracks((twice, own), 10), [100, 100])
    assert set(chosen[0]) == set(chosen[1]) == set(range(10)) - {1}


def test_bundles_are_asked_as_robots_are() -> None:
    bundles = [random_bundle(seed, points=40) for seed in range(3)]
    names = [MapName(f'd{k}/1', f'd{k}', id_space='site') for k in range(3)]
    chosen = choose_for_bundles(bundles, names, 12)
    announced = [announce(bundle, name) for bundle, name in zip(bundles, names, strict=True)]
    requests = plan_requests(
        announced, tracks_by_id(announced), FusionConfig(request_landmarks=12)
    )
    for request, ids in zip(requests, chosen, strict=True):
        assert len(ids) == 12
        np.testing.assert_array_equal(request.landmark_ids, ids)
