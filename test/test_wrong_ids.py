# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot that numbers its landmarks anew: told at once, and nobody else pays for it."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapmerge_ros.fusion import FusionConfig, State, fuse
from mapmerge_ros.fusion.associate import associate_by_id
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.fusion.pair_frames import align_pairs
from mapmerge_ros.fusion.wrong_ids import Unlike, why_unlike
from mapmerge_ros.geometry import Gauge, Segments, Similarity
from mapmerge_ros.io import read_submaps
from mapmerge_ros.simulation import FleetConfig, simulate_fleet
from mapmerge_ros.simulation.drones import Sensing
from mapmerge_ros.submap import LandmarkInformation
from mapmerge_ros.submap.triangle import pack

RNG = np.random.default_rng


@pytest.fixture(scope='module')
def submaps():
    from ros_processes import SHIPPED

    newest = {item.submap.map_id: item.submap for item in read_submaps(SHIPPED)}
    return tuple(newest[name] for name in sorted(newest))


def renumbered(submap, share, seed=0):
    """Compressed ids of a share of the landmarks dealt out anew among them."""
    rng, ids = RNG(seed), submap.landmark_ids.copy()
    some = rng.permutation(submap.compressed_count)[: int(share * submap.compressed_count)]
    ids[some] = ids[rng.permutation(some)]
    return replace(submap, landmark_ids=ids)


def positions(fusion):
    landmarks = fusion.components[0].landmarks
    return dict(zip(landmarks.ids.tolist(), landmarks.points_global, strict=True))


@pytest.mark.parametrize('how', ['shuffled', 'rolled'])
def test_a_robot_that_numbers_anew_stays_apart_and_hurts_nobody(submaps, how):
    wrong, rest = submaps[1], (submaps[0], *submaps[2:])
    if how == 'rolled':
        m, ids = wrong.compressed_count, wrong.landmark_ids.copy()
        ids[:m] = np.roll(ids[:m], 1)
        wrong = replace(wrong, landmark_ids=ids)
    else:
        wrong = renumbered(wrong, 1.0)
    fusion, alone = fuse((*rest, wrong)), fuse(rest)
    (apart,) = fusion.in_state(State.DETACHED)
    assert apart.submap.map_id == wrong.map_id
    assert 'are not the same points' in apart.reason
    assert len(fusion.in_state(State.MERGED)) == 3
    assert fusion.verdict.accepted
    assert len(fusion.contradictions) > 50
    expected = positions(alone)
    found = positions(fusion)
    assert found.keys() == expected.keys()  # what others have in common with it keeps its name
    for name, point in expected.items():
        np.testing.assert_allclose(found[name], point, atol=1e-6)


@pytest.mark.parametrize('share', [0.2, 0.4, 0.5])
def test_of_a_map_with_some_wrong_ids_the_right_ones_count(submaps, share):
    wrong = renumbered(submaps[1], share)
    fusion = fuse((submaps[0], wrong, *submaps[2:]))
    assert len(fusion.in_state(State.MERGED)) == 4
    assert fusion.verdict.accepted
    assert not any(change.object_id for change in fusion.changes)  # nothing moved
    found = {item.submap.map_id: item.S_global_map for item in fusion.alignments}
    true = {item.submap.map_id: item.S_global_map for item in fuse(submaps).alignments}
    for name, S_global_map in true.items():
        points = submaps[0].points
        off = np.linalg.norm(S_global_map.apply(points) - found[name].apply(points), axis=1)
        assert np.median(off) < 0.1


def test_ids_exchanged_nearby_are_told_where_others_are_wrong(submaps):
    """Among many wrong ids those of points that lie close together are wrong as well."""
    first, second = submaps[:2]
    _, rows, _ = np.intersect1d(first.compressed_ids, second.compressed_ids, return_indices=True)
    points, exchanged = first.points.copy(), rows[: len(rows) // 4]
    points[exchanged] = np.roll(points[exchanged], 1, axis=0)
    extent = np.median(np.linalg.norm(points[rows] - np.median(points[rows], axis=0), axis=1))
    weights = LandmarkInformation.of(first.triangle()).weights[rows]
    near = rows[len(exchanged) + np.argmax(weights[len(exchanged) :])]
    points[near] += [0.1 * extent, 0.0, 0.0]  # half of what makes a contradiction by itself

    def contradicting(of_first):
        both = (replace(first, points=of_first), second)
        association = associate_by_id(both)
        (link,) = find_links(both, association, FusionConfig())
        own = np.isin(association.tracks[0], link.contradicting)
        return set(first.compressed_ids[own].tolist())

    told = contradicting(points)
    assert first.compressed_ids[near] in told
    assert set(first.compressed_ids[exchanged].tolist()) <= told
    assert len(told) < len(rows) // 4 + 3
    alone = first.points.copy()
    alone[near] = points[near]
    assert not contradicting(alone)


@pytest.mark.parametrize('gauge', [Gauge.SIMILARITY, Gauge.RIGID])
def test_a_pair_of_which_not_even_a_quarter_agrees_is_unlike(gauge):
    rng, own, config = RNG(3), Segments.of_lengths([40]), FusionConfig()
    here, far = rng.normal(size=(40, 3)), 0.3 * rng.normal(size=(40, 3))
    there = here + 0.001 * rng.normal(size=(40, 3))

    def found(points, precision=1e4):
        gauges, known = np.array([int(gauge)]), np.full(40, precision)
        return why_unlike(here, points, points, known, own, gauges, config)

    assert not found(there)
    assert not found(there + far * (np.arange(40) % 2)[:, None])
    assert found(there + far) == {0: Unlike.NUMBERED_ANEW}
    # The same distance means nothing where landmarks are not known better than that.
    assert not found(there + far, precision=1.0)


def mirrored(submap, mirror):
    """Left-handed axes, R and all."""
    columns = np.tile(mirror, submap.compressed_count)
    return replace(
        submap, points=submap.points * mirror, packed_r=pack(submap.triangle() * columns)
    )


@pytest.mark.parametrize(('gauge', 'axis'), [(7, 0), (6, 2), (4, 2), (4, 0)])
def test_a_mirrored_map_is_called_so(gauge, axis):
    """From above nearly flat: its pairs hardly show it, the merge does; unless up is down."""
    pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres')
    fleet = simulate_fleet(FleetConfig(drones=4, sensing=Sensing(gauge=Gauge(gauge))), seed=4)
    submaps = fleet.submaps(catalogue=False)
    wrong = mirrored(submaps[1], np.where(np.arange(3) == axis, -1.0, 1.0))
    fusion = fuse([submaps[0], wrong, *submaps[2:]])
    (apart,) = (item for item in fusion.alignments if item.reason)
    assert apart.submap.map_id == wrong.map_id
    assert apart.state in (State.DETACHED, State.REFUSED)
    assert 'mirror image' in apart.reason
    assert 'left-handed' in apart.reason
    assert len(fusion.contradictions) < 3
    assert len(fusion.in_state(State.MERGED)) == 3


def test_pairs_that_are_not_flat_show_a_mirrored_map():
    rng, mirror = RNG(6), np.array([1.0, 1.0, -1.0])
    here = rng.normal(size=(30, 3))
    there = Similarity.exp(rng.normal(size=7)).apply(here * mirror)
    own, gauges, known = Segments.of_lengths([30]), np.array([7]), np.full(30, 1e4)
    moved = align_pairs(here, there, own, gauges, known).S_target_source.apply(own, there)
    unlike = why_unlike(here, there, moved, known, own, gauges, FusionConfig())
    assert unlike == {0: Unlike.MIRRORED}


def pair(rng, count, wrong, gauge):
    """Points in two frames, the first `wrong` of them matched with others."""
    there = rng.normal(size=(count, 3)) * [10.0, 6.0, 2.0]
    motion = np.append(rng.normal(size=6), np.log(0.3 if gauge is Gauge.SIMILARITY else 1.0))
    if gauge is Gauge.YAW_TRANSLATION:
        motion[:2] = 0.0
    S_a_b = Similarity.exp(motion)
    here = S_a_b.apply(there) + 0.01 * rng.normal(size=there.shape)
    here[:wrong] = here[np.roll(np.arange(wrong), 1)]
    return here, there, S_a_b


@pytest.mark.parametrize('gauge', [Gauge.SIMILARITY, Gauge.RIGID, Gauge.YAW_TRANSLATION])
@pytest.mark.parametrize('wrong', [0, 10, 14])
def test_the_frame_is_that_of_the_landmarks_that_agree(gauge, wrong):
    here, there, S_a_b = pair(RNG(5), 30, wrong, gauge)
    found = align_pairs(
        here, there, Segments.of_lengths([30]), np.array([int(gauge)]), np.ones(30)
    )
    assert found.determined.all()
    off = np.linalg.norm(found.S_target_source[0].apply(there) - S_a_b.apply(there), axis=1)
    assert np.median(off) < 0.15


def test_landmarks_that_determine_no_frame_are_not_called_wrong(submaps):
    """All on one line: the frames may be anywhere about it, and that is the reason given."""
    first = submaps[0]
    rows = np.flatnonzero(np.isin(first.compressed_ids, submaps[1].compressed_ids))
    assert len(rows) >= 8
    on_line = first.points.copy()
    on_line[rows] = np.outer(np.linspace(0.0, 9.0, len(rows)), [1.0, 2.0, 0.5])
    links = find_links(
        (replace(first, points=on_line), submaps[1]),
        associate_by_id((first, submaps[1])),
        FusionConfig(),
    )
    (link,) = links
    assert link.S_a_b is None
    assert 'not the same points' not in link.reason
    assert not len(link.contradicting)


def test_pairs_do_not_depend_on_each_other():
    first, second = pair(RNG(1), 20, 12, Gauge.SIMILARITY), pair(RNG(2), 40, 0, Gauge.SIMILARITY)
    both = align_pairs(
        *(np.concatenate([a, b]) for a, b in zip(first[:2], second[:2], strict=True)),
        Segments.of_lengths([20, 40]),
        np.array([7, 7]),
        np.ones(60),
    )
    for k, (here, there, _) in enumerate((first, second)):
        alone = align_pairs(
            here, there, Segments.of_lengths([len(here)]), np.array([7]), np.ones(len(here))
        )
        np.testing.assert_allclose(
            both.S_target_source[k].log(), alone.S_target_source[0].log(), atol=1e-9
        )


def test_the_benchmark_tells_who_is_merged_and_who_is_not(submaps):
    sys.path.insert(0, str(Path(__file__).parents[1] / 'benchmarks'))
    import wrong_ids

    right = list(wrong_ids.cases(0.0, [submaps[:3]]))
    assert [(case.merged, case.misplaced, case.innocent) for case in right] == [(True, 0, 0)] * 3
    wrong = list(wrong_ids.cases(1.0, [submaps[:3]]))
    assert not any(case.merged or case.misplaced for case in wrong)
    away, fusion = submaps[1], fuse(submaps)
    moved = tuple(
        replace(item, S_global_map=Similarity.exp(np.ones(7)) @ item.S_global_map)
        if item.submap.map_id == away.map_id
        else item
        for item in fusion.alignments
    )
    assert wrong_ids.misplaced(replace(fusion, alignments=moved), fusion) == [away.map_id]
    assert '| 100% | 3 | 0 | 0 | 3 |' in wrong_ids.row(1.0, wrong)
