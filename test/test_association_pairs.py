# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pairs of sub-maps without common ids: found where they overlap, never where they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mapmerge_ros.association import AssociationConfig, Decision, match_pair, nearest
from mapmerge_ros.geometry import Gauge, Similarity, align
from mapmerge_ros.submap import Descriptors, DescriptorType, Source, SubMap

CONFIG = AssociationConfig()
COMMON = 60


def catalogue(name, points, rows, *, kind=DescriptorType.BINARY, gauge=Gauge.SIMILARITY):
    """Bare announcement of a map."""
    count = len(points)
    return SubMap(
        map_id=name,
        robot_id=name,
        revision=1,
        stamp_ns=0,
        frame_id=name,
        sources=(Source(name, 1),),
        gauge=gauge,
        id_space='',
        landmark_ids=np.arange(count, dtype=np.uint64) + 7,
        points=points,
        covariances=np.tile([1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6], (count, 1)),
        compressed_count=0,
        a=0.0,
        packed_r=np.zeros(0, np.float32),
        c=np.zeros(0),
        residual_count=0,
        dof=0,
        sigma=1.0,
        descriptors=Descriptors(kind, rows),
    )


def random_frame(rng, gauge):
    """Any transform of the group."""
    tangent = rng.normal(size=7)
    tangent[6] *= gauge is Gauge.SIMILARITY
    if gauge is Gauge.YAW_TRANSLATION:
        tangent[:2] = 0.0
    return Similarity.identity() if gauge is Gauge.NONE else Similarity.exp(tangent)


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
    a = catalogue('a', points_a, rows_a, kind=kind, gauge=gauge)
    return a, catalogue('b', points_b, rows_b, kind=kind, gauge=gauge), S_a_b


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


def permuted(submap, rows):
    return replace(
        submap,
        landmark_ids=submap.landmark_ids[rows],
        points=submap.points[rows],
        covariances=submap.covariances[rows],
        descriptors=submap.descriptors[rows],
    )


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
