# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pairs of sub-maps without common ids: found where they overlap, never where they do not."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from associated import permuted, real_maps

from mapmerge_ros.association import AssociationConfig, Decision, match_pair, nearest
from mapmerge_ros.bundle import compress
from mapmerge_ros.geometry import Gauge, align
from mapmerge_ros.simulation import (
    StreetConfig,
    announcement,
    random_frame,
    simulate_street,
)
from mapmerge_ros.submap import Descriptors, DescriptorType

CONFIG = AssociationConfig()
COMMON = 60
STD = 1e-3


def random_pair(seed, *, kind=DescriptorType.BINARY, gauge=Gauge.SIMILARITY, noise=0.002):
    """Two maps with `COMMON` landmarks of 200 and 150 in common, and S_a_b."""
    rng = np.random.default_rng(seed)
    size = 32 if kind is DescriptorType.BINARY else 128
    points_a, points_b = rng.normal(size=(200, 3)), rng.normal(size=(150, 3))
    points_b[:COMMON] = points_a[:COMMON]
    rows_a = rng.integers(0, 256, (200, size), dtype=np.uint8)
    rows_b = rng.integers(0, 256, (150, size), dtype=np.uint8)
    seen = rows_a[:COMMON]
    if kind is DescriptorType.BINARY:
        flips = rng.random((*seen.shape, 8)) < 0.08
        rows_b[:COMMON] = seen ^ np.packbits(flips, axis=-1)[..., 0]
    else:
        rows_b[:COMMON] = np.clip(seen + rng.normal(0.0, 20.0, seen.shape), 0, 255)
    S_a_b = random_frame(rng, gauge)
    points_b = S_a_b.inverse().apply(points_b + noise * rng.normal(size=points_b.shape))
    a = announcement('a', points_a, rows_a, STD, kind, gauge)
    return a, announcement('b', points_b, rows_b, STD, kind, gauge), S_a_b


def pairs_of(match, a, b):
    """Matches as a set of id pairs."""
    return set(zip(a.landmark_ids[match.rows_a], b.landmark_ids[match.rows_b], strict=True))


@pytest.mark.parametrize('gauge', list(Gauge))
@pytest.mark.parametrize('kind', [DescriptorType.BINARY, DescriptorType.SIFT])
def test_a_known_transform_is_recovered_in_every_group(gauge, kind):
    a, b, S_a_b = random_pair(1, kind=kind, gauge=gauge)
    match = match_pair(a, b, CONFIG)
    assert match.decision is Decision.JOINED, match.reason
    assert np.abs(match.S_a_b.apply(b.points) - S_a_b.apply(b.points)).max() < 0.01
    right = match.rows_a == match.rows_b
    assert right.all()
    assert len(right) >= 0.9 * COMMON
    again = align(match.S_a_b.apply(b.points), b.points, gauge=gauge)
    assert again.rms < 1e-9, 'not in the group of the gauge'


def test_the_pair_takes_the_larger_gauge():
    a, b, _ = random_pair(2)
    metric = replace(a, gauge=Gauge.RIGID)
    match = match_pair(metric, b, CONFIG)
    assert match.decision is Decision.JOINED
    assert abs(np.log(match.S_a_b.scale)) > 0.01


def test_exchanged_maps_give_the_same_matches():
    a, b, _ = random_pair(3)
    one, other = match_pair(a, b, CONFIG), match_pair(b, a, CONFIG)
    assert one.decision is other.decision
    assert one.evidence.log_nfa == other.evidence.log_nfa
    assert np.array_equal(one.rows_a, other.rows_b)
    assert np.array_equal(one.candidates_b, other.candidates_a)
    assert other.tolerance_a == pytest.approx(one.tolerance_a / one.S_a_b.scale)
    round_trip = one.S_a_b @ other.S_a_b
    assert np.abs(round_trip.log()).max() < 1e-9


def test_the_order_of_landmarks_does_not_matter():
    a, b, _ = random_pair(4)
    mixed = permuted(b, np.random.default_rng(0).permutation(len(b.points)))
    one, other = match_pair(a, b, CONFIG), match_pair(a, mixed, CONFIG)
    assert pairs_of(one, a, b) == pairs_of(other, a, mixed)
    assert np.array_equal(one.S_a_b.rotation, other.S_a_b.rotation)


def test_descriptors_of_another_kind_are_kept_apart_with_a_reason():
    a, b, _ = random_pair(5)
    sift = random_pair(5, kind=DescriptorType.SIFT)[1]
    none = replace(b, descriptors=Descriptors.none(len(b.points)))
    short = replace(b, descriptors=Descriptors(DescriptorType.BINARY, b.descriptors.rows[:, :16]))
    for other, word in ((sift, 'SIFT'), (none, 'NONE'), (short, '16 bytes')):
        match = match_pair(a, other, CONFIG)
        assert match.decision is Decision.APART
        assert word in match.reason
        assert match.S_a_b is None


@pytest.mark.parametrize('kind', [DescriptorType.BINARY, DescriptorType.SIFT])
def test_equal_descriptors_are_not_distinctive(kind):
    a, b, _ = random_pair(6, kind=kind)
    same = Descriptors(kind, np.full_like(b.descriptors.rows, 5))
    assert not len(nearest(same, same, CONFIG))
    assert not len(nearest(a.descriptors, same, CONFIG))
    match = match_pair(a, replace(b, descriptors=same), CONFIG)
    assert match.decision is Decision.APART


@pytest.mark.parametrize('kind', [DescriptorType.BINARY, DescriptorType.SIFT])
def test_landmarks_without_descriptor_never_match(kind):
    a, b, _ = random_pair(7, kind=kind)
    rows_a, rows_b = a.descriptors.rows.copy(), b.descriptors.rows.copy()
    rows_a[:10], rows_b[:10] = 0, 0
    found = nearest(Descriptors(kind, rows_a), Descriptors(kind, rows_b), CONFIG)
    assert len(found) >= 40
    assert found.rows_a.min() >= 10
    assert found.rows_b.min() >= 10


@pytest.mark.parametrize('kind', [DescriptorType.BINARY, DescriptorType.SIFT])
def test_nearest_neighbours_are_those_of_the_definition(kind):
    rng = np.random.default_rng(8)
    size = 32 if kind is DescriptorType.BINARY else 128
    # Few different bytes: ties and small distances happen.
    rows = [rng.integers(0, 3, (n, size), dtype=np.uint8) for n in (70, 50)]
    rows[1][:20] = rows[0][:20] ^ (rng.random((20, size)) < 0.1)
    found = nearest(*(Descriptors(kind, own) for own in rows), CONFIG)
    if kind is DescriptorType.BINARY:
        bits = [np.unpackbits(own, axis=1).astype(int) for own in rows]
        distances = np.abs(bits[0][:, None] - bits[1]).sum(axis=2).astype(float)
        limit = CONFIG.max_ratio_binary
    else:
        values = [own.astype(float) for own in rows]
        distances = np.linalg.norm(values[0][:, None] - values[1], axis=2)
        limit = CONFIG.max_ratio_sift
    expected = {}
    for i, j in np.ndindex(distances.shape):
        others = np.r_[np.delete(distances[i], j), np.delete(distances[:, j], i)]
        if distances[i, j] <= limit * others.min() and others.min() > 0.0:
            expected[i, j] = distances[i, j] / others.min()
    assert len(expected) >= 15
    got = dict(zip(zip(found.rows_a, found.rows_b, strict=True), found.ratios, strict=True))
    assert got.keys() == expected.keys()
    assert all(got[key] == pytest.approx(expected[key], rel=1e-6) for key in got)


def test_shuffled_descriptors_are_not_joined():
    for seed in range(10):
        a, b, _ = random_pair(seed)
        mixed = b.descriptors[np.random.default_rng(seed).permutation(len(b.points))]
        match = match_pair(a, replace(b, descriptors=mixed), CONFIG)
        assert match.decision is Decision.APART
        assert match.reason


def test_a_map_and_its_disjoint_half_are_not_joined():
    rng = np.random.default_rng(9)
    for seed in range(10):
        a, _, _ = random_pair(seed)
        side = a.points @ rng.normal(size=3)
        low, high = np.flatnonzero(side < -0.1), np.flatnonzero(side > 0.1)
        match = match_pair(permuted(a, low), replace(permuted(a, high), map_id='b'), CONFIG)
        assert match.decision is not Decision.JOINED


def test_what_is_known_of_landmarks_weighs():
    """Half of the landmarks are ten times worse, and say so."""
    a, b, S_a_b = random_pair(10, noise=0.001)
    rng = np.random.default_rng(10)
    poor = rng.random(len(a.points)) < 0.5
    points = a.points + np.where(poor[:, None], 0.05, 0.0) * rng.normal(size=a.points.shape)
    variance = np.where(poor, 0.05**2, 0.001**2)[:, None]
    told = replace(a, points=points, covariances=variance * [1, 0, 0, 1, 0, 1])
    untold = replace(told, covariances=None)
    error = {}
    for name, own in (('told', told), ('untold', untold)):
        match = match_pair(own, b, CONFIG)
        assert match.decision is Decision.JOINED
        error[name] = np.abs(match.S_a_b.apply(b.points) - S_a_b.apply(b.points)).max()
    assert error['told'] < 0.5 * error['untold']


# Repeated structure


@pytest.fixture(scope='module')
def street():
    pytest.importorskip('pycolmap', reason='simulated maps are adjusted by pycolmap')
    made = simulate_street(StreetConfig(facades=4, place_flip_ratio=0.04, own_flip_ratio=0.06), 5)
    return made, [
        compress(bundle, name, bundle.point_ids[:0])
        for bundle, name in zip(made.bundles, made.names, strict=True)
    ]


def test_identical_facades_are_not_joined(street):
    made, maps = street
    tempting = 0
    for i, j in combinations(range(len(maps)), 2):
        if made.facades[i] != made.facades[j]:
            assert not len(np.intersect1d(made.landmark_ids[i], made.landmark_ids[j]))
            match = match_pair(maps[i], maps[j], CONFIG)
            assert match.decision is not Decision.JOINED
            if match.evidence.log_nfa < -20.0:
                tempting += 1
                assert 'repeated structure' in match.reason
    assert tempting >= 10, 'the scene is no trap'


def test_the_same_facade_is_joined_and_its_matches_are_right(street):
    made, maps = street
    for i, j in combinations(range(len(maps)), 2):
        if made.facades[i] == made.facades[j]:
            match = match_pair(maps[i], maps[j], CONFIG)
            assert match.decision is Decision.JOINED, match.reason
            same = made.landmark_ids[i][match.rows_a] == made.landmark_ids[j][match.rows_b]
            assert same.mean() > 0.98


# Real maps


@pytest.mark.parametrize(
    ('name', 'least', 'precision'),
    [('euroc_v101_maplab', 25, 0.75), ('brighton_drone', 1, 0.97)],
)
def test_real_maps_are_joined(name, least, precision):
    maps = real_maps(name)
    matches = {
        (i, j): match_pair(maps[i], maps[j], CONFIG) for i, j in combinations(range(len(maps)), 2)
    }
    joined = {pair: own for pair, own in matches.items() if own.decision is Decision.JOINED}
    assert len(joined) >= least
    same = [
        maps[i].landmark_ids[own.rows_a] == maps[j].landmark_ids[own.rows_b]
        for (i, j), own in joined.items()
    ]
    assert np.concatenate(same).mean() > precision


def test_halves_and_shuffled_real_maps_are_not_joined():
    maps = real_maps('euroc_v101_maplab')
    rng = np.random.default_rng(11)
    for k, own in enumerate(maps):
        side = own.points @ rng.normal(size=3)
        low, high = np.quantile(side, [0.48, 0.52])
        halves = permuted(own, side < low), replace(permuted(own, side > high), map_id='other')
        other = maps[(k + 1) % len(maps)]
        mixed = other.descriptors[rng.permutation(len(other.points))]
        for a, b in (halves, (own, replace(other, descriptors=mixed))):
            assert match_pair(a, b, CONFIG).decision is not Decision.JOINED
