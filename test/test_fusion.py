# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The engine around the merge: revisions, provenance, components, contradictions, the frame."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import random_bundle

from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import FusionConfig, FusionEngine, State, fuse
from mapmerge_ros.fusion.region import p_value_of
from mapmerge_ros.geometry import Similarity, align
from mapmerge_ros.submap import Source

CLOUD = random_bundle(0, points=40)


def view(name, rows, *, seed=0, revision=1, id_space='site', stamp_ns=0, compressed=True):
    """Sub-map of some points of one scene, with noise of its own and in its own frame."""
    bundle = random_bundle(0, points=40, noise_px=0.0)
    noise = 0.3 * np.random.default_rng(seed).normal(size=bundle.observations_px.shape)
    noisy = replace(bundle, observations_px=bundle.observations_px + noise)
    ids = bundle.point_ids[list(rows)] if compressed else []
    submap = compress(
        noisy,
        MapName(name, name.partition('/')[0], revision, stamp_ns, name, id_space),
        ids,
        catalogue=not compressed,
    )
    return submap.transformed(Similarity.exp(np.random.default_rng(seed).normal(size=7)))


A, B, C = (
    view('a', range(0, 14), seed=1),
    view('b', range(8, 24), seed=2),
    view('c', range(18, 34), seed=3),
)


def states(fusion):
    return {item.submap.map_id: item.state for item in fusion.alignments}


def reason(fusion, map_id):
    return next(item.reason for item in fusion.alignments if item.submap.map_id == map_id)


def test_three_overlapping_maps_become_one_that_is_believed():
    fusion = fuse([A, B, C])
    assert set(states(fusion).values()) == {State.MERGED}
    assert fusion.verdict.dof == 3 * (6 + 6) - 14
    assert fusion.verdict.accepted
    assert fusion.components[0].converged
    members = dict(
        zip(
            fusion.components[0].landmarks.ids,
            fusion.components[0].landmarks.members(),
            strict=True,
        )
    )
    assert members[A.landmark_ids[8]] == [('a', A.landmark_ids[8]), ('b', A.landmark_ids[8])]
    assert [(pair.a, pair.b, pair.shared) for pair in fusion.pairs] == [
        ('a', 'b', 6),
        ('b', 'c', 6),
    ]


@pytest.mark.parametrize('most', [5, 500])
@pytest.mark.parametrize('id_space', ['site', ''])
def test_landmarks_that_go_on_as_catalogue_are_where_they_were_merged(most, id_space):
    """Not in the mean of where each sub-map by itself has them, which is as good as nothing."""
    maps = [A, B, C] if id_space else [replace(A, id_space=''), B, C]
    fusion = fuse(maps, FusionConfig(max_landmarks=most))
    landmarks, submap = fusion.components[0].landmarks, fusion.global_map
    assert submap.compressed_count == min(most, len(landmarks.ids))
    order = np.argsort(submap.landmark_ids)
    rows = order[np.searchsorted(submap.landmark_ids[order], landmarks.ids)]
    np.testing.assert_array_equal(submap.landmark_ids[rows], landmarks.ids)
    np.testing.assert_allclose(submap.points[rows], landmarks.points_global, atol=1e-9)


def test_a_newer_revision_replaces_and_an_older_one_changes_nothing():
    engine = FusionEngine()
    assert engine.add(A).accepted
    assert engine.add(B).accepted
    newer = view('a', range(0, 20), seed=4, revision=3)
    assert engine.add(newer).accepted
    for stale in (newer, replace(A, revision=2)):
        receipt = engine.add(stale)
        assert not receipt.accepted
        assert 'not newer than 3' in receipt.reason
    assert engine.fuse().pairs[0].shared == 12


def test_no_measurement_counts_twice():
    pair = fuse([A, B], FusionConfig(map_id='pair')).global_map
    fusion = fuse([pair, B, C])
    assert states(fusion) == {'pair': State.MERGED, 'b': State.REFUSED, 'c': State.MERGED}
    assert reason(fusion, 'b') == 'its data would count twice: b is already inside pair'
    assert fusion.global_map.sources == (Source('a', 1), Source('b', 1), Source('c', 1))


def test_our_own_output_is_not_taken_in():
    engine = FusionEngine(FusionConfig(map_id='fleet/global'))
    receipt = engine.add(replace(A, map_id='fleet/global'))
    assert not receipt.accepted
    assert 'publishes' in receipt.reason


def test_maps_that_share_too_little_stay_apart_and_say_so():
    lonely = view('lonely', [0, 1, 2, 35, 36, 37, 38], seed=5)
    fusion = fuse([A, B, lonely])
    assert states(fusion)['lonely'] is State.DETACHED
    assert reason(fusion, 'lonely') == 'best overlap is with a: 3 landmarks in common, 4 needed'
    assert [component.map_ids for component in fusion.components] == [('a', 'b'), ('lonely',)]


def test_two_separate_groups_are_two_components():
    d, e = view('d', range(34, 40), seed=6), view('e', range(34, 40), seed=7)
    fusion = fuse([A, B, d, e])
    assert [component.map_ids for component in fusion.components] == [('a', 'b'), ('d', 'e')]
    assert states(fusion)['d'] is State.DETACHED
    assert 'not with the published map' in reason(fusion, 'd')


def test_private_ids_are_not_mixed_up():
    private = replace(view('p', range(0, 14), seed=8), id_space='')
    elsewhere = replace(view('q', range(0, 14), seed=9), id_space='another')
    fusion = fuse([A, B, private, elsewhere])
    assert states(fusion)['p'] is State.DETACHED
    assert 'private' in reason(fusion, 'p')
    assert "id space 'another'" in reason(fusion, 'q')


def test_an_announcement_waits():
    fusion = fuse([A, B, view('new', [], compressed=False)])
    assert states(fusion)['new'] is State.DETACHED
    assert 'announcement' in reason(fusion, 'new')


def test_one_map_alone_is_published_as_it_is():
    fusion = fuse([A])
    assert states(fusion) == {'a': State.DETACHED}
    assert 'only sub-map' in reason(fusion, 'a')
    assert fusion.verdict.dof == 0
    r = A.triangle()  # the map was sent off its optimum: c takes it there
    optimum = A.compressed_points.ravel() + np.linalg.lstsq(r, -A.c, rcond=None)[0]
    optimum = optimum.reshape(-1, 3)[np.argsort(A.compressed_ids)]
    merged = fusion.global_map.compressed_points
    np.testing.assert_allclose(
        align(optimum, merged).S_target_source.apply(merged), optimum, atol=1e-4
    )
    assert fusion.verdict.a_tilde < 1e-12


def test_nothing_fuses_to_nothing():
    fusion = fuse([])
    assert fusion.global_map is None
    assert fusion.alignments == ()


def test_collinear_overlap_does_not_join():
    ids = np.arange(6, dtype=np.uint64)
    line = np.linspace(0, 1, 6)[:, None] * np.array([1.0, 2.0, 3.0])

    def on_a_line(submap):
        points = submap.points.copy()
        points[:6] = line
        return replace(
            submap, points=points, landmark_ids=np.concatenate([ids, submap.landmark_ids[6:]])
        )

    fusion = fuse(
        [on_a_line(view('a', range(0, 12), seed=1)), on_a_line(view('b', range(12, 24), seed=2))]
    )
    assert 'line' in reason(fusion, 'a')


def test_an_id_given_to_two_points_is_split_and_reported():
    bad = view('b', range(4, 24), seed=2)
    ids = bad.landmark_ids.copy()
    ids[[0, 15]] = ids[[15, 0]]  # the id of a point that A has goes to one that A lacks
    ids[[2, 7]] = ids[[7, 2]]  # two points that A has exchange their ids
    fusion = fuse([A, replace(bad, landmark_ids=ids)])
    clashing = {int(ids[15]), int(ids[2]), int(ids[7])}
    assert {item.landmark_id for item in fusion.contradictions} == clashing
    assert {(item.a, item.b) for item in fusion.contradictions} == {('a', 'b')}
    assert fusion.verdict.accepted
    assert not clashing & set(map(int, fusion.global_map.landmark_ids))
    landmarks = fusion.components[0].landmarks
    assert not clashing & set(map(int, landmarks.ids))
    assert p_value_of(fusion, landmarks.ids, landmarks.points_global) == pytest.approx(1.0)


def test_the_global_frame_stays_where_it_was():
    engine = FusionEngine()
    engine.add(replace(B, stamp_ns=5))
    engine.add(replace(C, stamp_ns=6))
    before = engine.fuse()
    assert before.components[0].anchor == 'b'
    engine.add(replace(A, stamp_ns=1))  # older, but the frame is taken
    after = engine.fuse()
    assert after.components[0].anchor == 'b'
    placed = {item.submap.map_id: item.S_global_map for item in before.alignments}
    again = {item.submap.map_id: item.S_global_map for item in after.alignments}
    np.testing.assert_allclose(again['b'].log(), placed['b'].log(), atol=1e-9)
    assert after.global_map.revision > before.global_map.revision


def test_a_fusion_leaves_the_engine_unchanged_until_something_comes():
    engine = FusionEngine()
    assert not engine.changed
    engine.add(A)
    assert engine.changed
    engine.fuse()
    assert not engine.changed
    assert engine.remove(['a', 'unknown']) == 1
    assert engine.changed
    assert engine.fuse().global_map is None


def test_a_noise_free_merge_costs_nothing_and_is_believed():
    def clean(name, rows, seed):
        bundle = random_bundle(0, points=40, noise_px=0.0)
        return compress(
            bundle, MapName(name, name, id_space='site'), bundle.point_ids[list(rows)]
        ).transformed(Similarity.exp(np.random.default_rng(seed).normal(size=7)))

    fusion = fuse(
        [
            replace(clean('a', range(12), 1), sigma=0.5),
            replace(clean('b', range(4, 20), 2), sigma=0.5),
        ]
    )
    assert fusion.verdict.accepted
    assert fusion.verdict.a_tilde < 1e-4


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('min_shared', 2),
        ('significance', 1.5),
        ('max_iterations', 0),
        ('map_id', ''),
        ('max_landmarks', 1),
    ],
)
def test_settings_are_checked(name, value):
    with pytest.raises(InvalidValue, match=name):
        FusionConfig(**{name: value})


@pytest.mark.parametrize(
    ('what', 'change'),
    [
        ('r', lambda m: {'packed_r': 1e-300 * m.packed_r.astype(float)}),
        ('points', lambda m: {'points': 1e-200 * m.points}),
        ('points', lambda m: {'points': 0.0 * m.points}),
        ('r', lambda m: {'packed_r': np.where(np.arange(len(m.packed_r)) == 0, 1e14, 0.0)}),
        ('sigma', lambda m: {'sigma': 1e-14}),
        ('r', lambda m: {'packed_r': 1e9 * m.packed_r}),
        ('a', lambda m: {'a': 1e14}),
    ],
)
def test_absurd_numbers_of_one_map_do_not_take_the_others_along(what, change):
    """They may be refused, left apart or make the test refuse; the others are merged anyway."""
    with np.errstate(all='ignore'):
        fusion = fuse([A, B, C, replace(view('z', range(0, 14), seed=9), **change(A))])
    assert {states(fusion)[map_id] for map_id in 'abc'} == {State.MERGED}, what
    assert np.isfinite(fusion.global_map.points).all()


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('points', np.full((14, 3), 1e200)),
        ('a', 1e200),
        ('sigma', 1e200),
        ('packed_r', np.zeros(0)),
    ],
)
def test_numbers_beyond_all_measure_are_refused(name, value):
    if name == 'packed_r':
        value = np.zeros_like(A.packed_r)
    with pytest.raises(InvalidValue, match=name.removeprefix('packed_')):
        replace(A, **{name: value})
