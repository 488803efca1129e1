# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Fusion of robots without common ids: as good as with ids; copies are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from associated import partition

from mapmerge_ros.association import Memory, associate
from mapmerge_ros.bundle import announce, compress
from mapmerge_ros.bundle.answer import answer
from mapmerge_ros.bundle.selection import matched
from mapmerge_ros.fusion import FusionEngine, State, fuse
from mapmerge_ros.fusion.offline import choose_for_bundles
from mapmerge_ros.geometry import Similarity, align
from mapmerge_ros.io import decode_submap, encode_submap
from mapmerge_ros.simulation import FleetConfig, simulate_fleet
from mapmerge_ros.submap import Descriptors, DescriptorType, Source

pytest.importorskip('pycolmap', reason='pycolmap is missing: pip install mapmerge_ros[colmap]')

CAP = 60


@pytest.fixture(scope='module')
def fleet():
    """Four drones over one yard; every robot numbers its landmarks by itself."""
    return simulate_fleet(FleetConfig(ids='private'), seed=4)


@pytest.fixture(scope='module')
def submaps(fleet):
    """What they send when they are asked, over the air."""
    chosen = choose_for_bundles(fleet.bundles, fleet.names, CAP)
    return [
        decode_submap(encode_submap(compress(bundle, name, ids)))
        for bundle, name, ids in zip(fleet.bundles, fleet.names, chosen, strict=True)
    ]


def by_truth(fleet, submaps):
    """The same sub-maps with ids that mean the same to all robots."""
    named = []
    for submap, bundle, truth in zip(
        submaps, fleet.bundles, fleet.truth.landmark_ids, strict=True
    ):
        ids = truth[bundle.rows_of(submap.landmark_ids)]
        named.append(replace(submap, id_space='fleet', landmark_ids=ids))
    return named


def states(fusion):
    return {item.submap.map_id: item.state for item in fusion.alignments}


def reason(fusion, map_id):
    return next(item.reason for item in fusion.alignments if item.submap.map_id == map_id)


def members(fusion):
    """Merged landmarks of at least two maps: where, how sure, by their (map_id, id)."""
    landmarks = fusion.components[0].landmarks
    return {
        frozenset(own): (landmarks.points_global[row], landmarks.std[row])
        for row, own in enumerate(landmarks.members())
        if len(own) > 1
    }


def distances(fusion, other):
    """Of landmarks that both have, after a similarity, in standard deviations."""
    one, two = members(fusion), members(other)
    both = sorted(one.keys() & two.keys(), key=sorted)
    points, others = (np.array([own[key][0] for key in both]) for own in (one, two))
    std = np.linalg.norm([one[key][1] for key in both], axis=1)
    found = align(points, others).S_target_source
    return len(both) / len(one), np.linalg.norm(points - found.apply(others), axis=1) / std


def test_a_fleet_without_ids_is_merged_as_by_true_ids(fleet, submaps):
    engine = FusionEngine()
    for submap in submaps:
        assert engine.add(submap).accepted
    fusion = engine.fuse()
    assert set(states(fusion).values()) == {State.MERGED}
    assert fusion.verdict.accepted, fusion.verdict.reason
    assert fusion.global_map.id_space == ''
    rename = {}
    truth = by_truth(fleet, submaps)
    for private, public in zip(submaps, truth, strict=True):
        ids = zip(public.landmark_ids.tolist(), private.landmark_ids.tolist(), strict=True)
        rename[private.map_id] = dict(ids)
    expected = fuse(truth)
    landmarks = expected.components[0].landmarks
    back = np.array(
        [
            rename[map_id][int(own)]
            for map_id, own in zip(landmarks.member_maps, landmarks.member_ids, strict=True)
        ],
        np.uint64,
    )
    component = replace(expected.components[0], landmarks=replace(landmarks, member_ids=back))
    share, apart = distances(fusion, replace(expected, components=(component,)))
    assert share > 0.95
    assert np.median(apart) < 0.2
    assert apart.max() < 1.0


def test_the_order_of_arrival_does_not_matter(submaps):
    engine = FusionEngine()
    for submap in reversed(submaps):
        engine.add(submap)
        fusion = engine.fuse()
    expected = fuse(submaps)
    assert members(fusion).keys() == members(expected).keys()
    assert distances(fusion, expected)[1].max() < 1e-3
    assert fusion.verdict.dof == expected.verdict.dof


def test_names_stay_when_a_robot_compresses_other_landmarks(fleet, submaps):
    """The name of a landmark depends on its first member, not on what is compressed."""
    engine = FusionEngine()
    for submap in submaps:
        engine.add(submap)
    before = engine.fuse().components[0]
    bundle, name = fleet.bundles[0], fleet.names[0]
    fewer = compress(bundle, replace(name, revision=2), submaps[0].compressed_ids[: CAP // 2])
    engine.add(fewer)
    after = engine.fuse().components[0]

    def named(component):
        landmarks = component.landmarks
        return {
            frozenset(own): int(name)
            for name, own in zip(landmarks.ids, landmarks.members(), strict=True)
        }

    one, two = named(before), named(after)
    both = one.keys() & two.keys()
    assert len(both) > 0.5 * len(one)
    assert all(one[key] == two[key] for key in both)
    assert len(np.unique(after.landmarks.ids)) == len(after.landmarks.ids)


def test_an_announcement_that_is_compressed_keeps_its_tracks(fleet):
    announced = [announce(b, n) for b, n in zip(fleet.bundles, fleet.names, strict=True)]
    memory = Memory()
    expected = partition(announced, associate(announced, memory=memory))
    chosen = choose_for_bundles(fleet.bundles, fleet.names, CAP)
    answered = [
        compress(bundle, replace(name, revision=2), ids)
        for bundle, name, ids in zip(fleet.bundles, fleet.names, chosen, strict=True)
    ]
    assert partition(answered, associate(answered, memory=memory)) == expected
    assert partition(answered, associate(answered)) == expected


def test_robots_that_announce_are_asked_for_what_is_common_and_then_merged(fleet):
    engine = FusionEngine()
    announced = [announce(b, n) for b, n in zip(fleet.bundles, fleet.names, strict=True)]
    for submap in announced:
        engine.add(submap)
    fusion = engine.fuse()
    assert fusion.components == ()
    asked = {request.map_id: request for request in fusion.requests}
    assert set(asked) == {submap.map_id for submap in announced}
    for bundle, submap in zip(fleet.bundles, announced, strict=True):
        found = answer(bundle, submap, asked[submap.map_id], 2)
        assert engine.add(found.submap).accepted
    fusion = engine.fuse()
    assert set(states(fusion).values()) == {State.MERGED}
    assert fusion.verdict.accepted
    assert fusion.requests == ()


@pytest.mark.parametrize('is_moved', [False, True])
def test_a_map_under_two_names_is_refused_and_the_rest_is_as_without_it(submaps, is_moved):
    twin = replace(
        submaps[1], map_id='twin', robot_id='twin', sources=(Source('twin', 1),), revision=7
    )
    if is_moved:
        frame = Similarity.exp(np.random.default_rng(0).normal(size=7))
        twin = decode_submap(encode_submap(twin.transformed(frame)))
    fusion, expected = fuse([twin, *submaps]), fuse(submaps)
    assert states(fusion) == {**states(expected), 'twin': State.REFUSED}
    assert 'count twice' in reason(fusion, 'twin')
    assert submaps[1].map_id in reason(fusion, 'twin')
    assert members(fusion).keys() == members(expected).keys()
    assert distances(fusion, expected)[1].max() < 1e-3


@pytest.mark.parametrize('is_moved', [False, True])
def test_a_map_under_two_names_in_one_id_space_is_refused_as_well(fleet, is_moved):
    names = [replace(name, id_space='yard') for name in fleet.names]
    bundles = [
        replace(bundle, point_ids=truth)
        for bundle, truth in zip(fleet.bundles, fleet.truth.landmark_ids, strict=True)
    ]
    chosen = matched(bundles, CAP)
    submaps = [
        compress(bundle, name, ids, catalogue=False)
        for bundle, name, ids in zip(bundles, names, chosen, strict=True)
    ]
    bundle = bundles[1]
    if is_moved:
        bundle = bundle.transformed(Similarity.exp(np.random.default_rng(0).normal(size=7)))
    twin = compress(bundle, replace(names[1], map_id='twin'), chosen[1][:-5], catalogue=False)
    fusion, expected = fuse([*submaps, twin]), fuse(submaps)
    assert states(fusion) == {**states(expected), 'twin': State.REFUSED}
    assert 'count twice' in reason(fusion, 'twin')
    assert distances(fusion, expected)[1].max() < 1e-9


def test_two_maps_of_one_place_are_no_copies(fleet):
    """As near to each other as real ones ever come: 1e-4 of the extent, here 3 mm."""
    bundle, name = fleet.bundles[0], fleet.names[0]
    noise = np.random.default_rng(0).normal(size=bundle.points.shape)
    near = replace(bundle, points=bundle.points + 1e-4 * np.std(bundle.points) * noise)
    other = replace(name, map_id='again', robot_id='again')
    ids = bundle.point_ids[:CAP]
    fusion = fuse([compress(bundle, name, ids), compress(near, other, ids)])
    assert set(states(fusion).values()) == {State.MERGED}
    name, other = (replace(each, id_space='yard') for each in (name, other))
    fusion = fuse([compress(bundle, name, ids), compress(near, other, ids)])
    assert set(states(fusion).values()) == {State.MERGED}


@pytest.mark.parametrize('size', [16, 32, 128])
def test_other_descriptors_are_kept_apart_with_the_reason(submaps, size):
    kind = DescriptorType.SIFT if size == 128 else DescriptorType.BINARY
    rng = np.random.default_rng(0)
    rows = rng.integers(1, 256, (len(submaps[0].points), size), dtype=np.uint8)
    other = replace(submaps[0], descriptors=Descriptors(kind, rows))
    fusion = fuse([other, *submaps[1:]])
    assert states(fusion)[other.map_id] is State.DETACHED
    assert {states(fusion)[x.map_id] for x in submaps[1:]} == {State.MERGED}
    if size != 32:
        assert 'different kinds' in reason(fusion, other.map_id)
        assert f'{size} bytes' in reason(fusion, other.map_id)


def test_maps_without_descriptors_and_without_ids_say_so(submaps):
    count = len(submaps[0].points)
    blind = replace(submaps[0], descriptors=Descriptors.none(count))
    fusion = fuse([blind, *submaps[1:]])
    assert states(fusion)[blind.map_id] is State.DETACHED
    assert 'no descriptors' in reason(fusion, blind.map_id)
