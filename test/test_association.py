# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The whole association: the same in any order, by pieces or at once; loops, ids, bad input."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from associated import partition, permuted, right_and_true, site

from mapmerge_ros.association import AssociationConfig, Decision, Memory, associate, match_pair
from mapmerge_ros.association.network import close_loops
from mapmerge_ros.geometry import Similarity
from mapmerge_ros.submap import Descriptors, DescriptorType

CONFIG = AssociationConfig()


@pytest.fixture(scope='module')
def row():
    """Four maps in a row: 0–3 overlap in nothing, all others do."""
    return site()


def turned(submap, seed=5):
    """The same map in another frame and scale."""
    return submap.transformed(Similarity.exp(np.random.default_rng(seed).normal(size=7)))


def test_nearly_all_true_links_are_found_and_hardly_any_other(row):
    submaps, seen = row
    links, right, true = right_and_true(seen, associate(submaps))
    assert right >= 0.99 * links
    assert right >= 0.97 * true


def test_neither_the_order_of_maps_nor_of_landmarks_leaves_a_trace(row):
    submaps, _ = row
    expected = partition(submaps, associate(submaps))
    rng = np.random.default_rng(0)
    for order in ([3, 1, 0, 2], [2, 3, 1, 0]):
        mixed = [permuted(submaps[k], rng.permutation(len(submaps[k].points))) for k in order]
        assert partition(mixed, associate(mixed)) == expected


def test_what_a_map_is_called_leaves_no_trace(row):
    submaps, _ = row
    before = associate(submaps)
    renamed = [replace(submap, map_id=f'{9 - k}') for k, submap in enumerate(submaps)]
    after = associate(renamed)
    assert before.matches.keys() == after.matches.keys()
    for a, b in before.matches:
        assert before.common(a, b) == after.common(a, b)
        np.testing.assert_array_equal(
            np.isin(before.tracks[a], before.tracks[b]), np.isin(after.tracks[a], after.tracks[b])
        )


def test_matches_are_about_the_maps_in_the_order_given(row):
    submaps, seen = row
    mixed, truth = [submaps[k] for k in (2, 0, 1)], [seen[k] for k in (2, 0, 1)]
    found = associate(mixed)
    assert set(found.matches) == {(0, 1), (0, 2), (1, 2)}
    for (a, b), match in found.matches.items():
        assert np.mean(truth[a][match.rows_a] == truth[b][match.rows_b]) > 0.95
        gaps = mixed[a].points[match.rows_a] - match.S_a_b.apply(mixed[b].points[match.rows_b])
        assert np.linalg.norm(gaps, axis=1).max() <= 1.01 * match.tolerance_a


def test_frames_and_scales_do_not_matter(row):
    submaps, _ = row
    moved = [turned(submap, k) for k, submap in enumerate(submaps)]
    one, other = (partition(own, associate(own)) for own in (submaps, moved))
    assert len(one ^ other) <= 0.01 * len(one)


def test_maps_that_come_one_by_one_give_the_same_as_all_at_once(row):
    submaps, _ = row
    memory = Memory()
    for count in range(1, len(submaps) + 1):
        found = associate(submaps[:count], memory=memory)
        assert partition(submaps[:count], found) == partition(
            submaps[:count], associate(submaps[:count])
        )


def test_with_a_memory_only_the_new_map_is_matched(row, monkeypatch):
    submaps, _ = row
    matched = []

    def counting(a, b, config):
        matched.append({a.map_id, b.map_id})
        return match_pair(a, b, config)

    monkeypatch.setattr('mapmerge_ros.association.memory.match_pair', counting)
    memory = Memory()
    associate(submaps[:3], memory=memory)
    matched.clear()
    associate(submaps, memory=memory)
    assert sorted(matched, key=sorted) == [{f'm{k}', 'm3'} for k in range(3)]
    matched.clear()
    associate([permuted(x, np.arange(len(x.points))[::-1]) for x in submaps], memory=memory)
    assert matched == []


def test_no_track_has_two_landmarks_of_one_map():
    """Every landmark has a near twin that looks alike: links contradict each other."""
    submaps, _ = site(seed=3)
    rng = np.random.default_rng(0)
    doubled = [
        replace(
            submap,
            landmark_ids=np.arange(2 * len(submap.points), dtype=np.uint64),
            points=np.concatenate([submap.points, submap.points + 0.05 * rng.normal(size=3)]),
            covariances=np.tile(submap.covariances, (2, 1)),
            descriptors=Descriptors(
                DescriptorType.BINARY, np.tile(submap.descriptors.rows, (2, 1))
            ),
        )
        for submap in submaps
    ]
    for tracks in associate(doubled).tracks:
        assert len(np.unique(tracks)) == len(tracks)


def all_matches(submaps):
    return {
        (a, b): match_pair(submaps[a], submaps[b], CONFIG)
        for a, b in combinations(range(len(submaps)), 2)
    }


@pytest.fixture(scope='module')
def three():
    """Three maps that all overlap, and their matches."""
    submaps = tuple(site(3, seed=1)[0])
    matches = all_matches(submaps)
    assert all(match.decision is Decision.JOINED for match in matches.values())
    return submaps, matches


def wrong(match):
    """The same match with an alignment that is off by half the scene."""
    return replace(match, S_a_b=match.S_a_b @ Similarity.exp(np.array([0, 0, 0.5, 0, 0, 0, 0])))


def test_a_wrong_join_is_thrown_out_by_its_loops(row):
    """1–2 is in two triangles; both fail, the other pairs of each are in one."""
    submaps = tuple(row[0])
    matches = all_matches(submaps)
    joined = {pair for pair, match in matches.items() if match.decision is Decision.JOINED}
    assert {(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)} <= joined
    network = close_loops(submaps, {**matches, (1, 2): wrong(matches[1, 2])})
    assert network.matches[1, 2].decision is Decision.UNDECIDED
    assert 'loop' in network.matches[1, 2].reason
    assert network.components == ((0, 1, 2, 3),)
    left = {x for x, match in network.matches.items() if match.decision is Decision.JOINED}
    assert left == joined - {(1, 2)}


def test_an_undecided_pair_is_settled_by_a_loop(three):
    submaps, matches = three
    doubt = replace(matches[0, 2], decision=Decision.UNDECIDED, reason='weak')
    confirmed = close_loops(submaps, {**matches, (0, 2): doubt}).matches[0, 2]
    assert confirmed.decision is Decision.JOINED
    refuted = close_loops(submaps, {**matches, (0, 2): wrong(doubt)}).matches[0, 2]
    assert refuted.decision is Decision.APART
    assert 'elsewhere' in refuted.reason


def test_undecided_pairs_alone_join_nothing(three):
    submaps, matches = three
    doubts = {
        pair: replace(match, decision=Decision.UNDECIDED, reason='weak') if 2 in pair else match
        for pair, match in matches.items()
    }
    network = close_loops(submaps, doubts)
    assert network.components == ((0, 1), (2,))
    assert {network.matches[pair].decision for pair in ((0, 2), (1, 2))} == {Decision.UNDECIDED}


def test_maps_of_one_id_space_are_linked_by_id_and_others_by_descriptors(row):
    submaps, seen = row
    fleet = [
        replace(submap, id_space='fleet', landmark_ids=rows.astype(np.uint64))
        for submap, rows in zip(submaps[:2], seen[:2], strict=True)
    ]
    mixed = [*fleet, *submaps[2:]]
    found = associate(mixed)
    assert (0, 1) not in found.matches
    assert found.common(0, 1) == len(np.intersect1d(seen[0], seen[1]))
    links, right, true = right_and_true(seen, found)
    assert right >= 0.99 * links
    assert right >= 0.97 * true


@pytest.mark.parametrize('rows', [0, 77])
def test_landmarks_that_all_look_alike_link_nothing(row, rows):
    """Zeros stand for: no descriptor."""
    submaps, _ = row
    same = [
        replace(
            submap,
            descriptors=Descriptors(
                DescriptorType.BINARY, np.full((len(submap.points), 32), rows, np.uint8)
            ),
        )
        for submap in submaps
    ]
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = associate(same)
    assert partition(same, found) == set()
    assert {match.decision for match in found.matches.values()} == {Decision.APART}


def test_landmarks_without_a_descriptor_are_found_by_where_they_are(row):
    """A third of one map has none; where nothing else is near, position is enough."""
    submaps, seen = row
    rows = submaps[1].descriptors.rows.copy()
    rows[::3] = 0
    found = associate(
        [submaps[0], replace(submaps[1], descriptors=Descriptors(DescriptorType.BINARY, rows))]
    )
    links, right, _ = right_and_true(seen[:2], found)
    assert right >= 0.99 * links
    common = np.intersect1d(found.tracks[0], found.tracks[1], return_indices=True)[2]
    assert (common % 3 == 0).sum() > 0.2 * len(common)


@pytest.mark.parametrize('known', [True, False])
def test_exact_copies_are_linked_without_a_warning(row, known):
    """Nothing is left to estimate a variance from; covariances may be missing as well."""
    first = row[0][0] if known else replace(row[0][0], covariances=None)
    copy = turned(replace(first, map_id='twin'))
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        found = associate([first, copy])
    assert found.common(0, 1) == len(first.points)


def test_one_map_and_none():
    assert associate([]).tracks == ()
    one = site(1)[0]
    assert partition(one, associate(one)) == set()
