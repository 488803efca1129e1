# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Experiments on scenes: bookshelf, office, corrupt; few runs each, and the parts they use."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip('pycolmap', reason='bundling needs pycolmap: pip install .[colmap]')

from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.errors import DegenerateGeometry
from mapmerge_ros.experiments import bookshelf, corrupt, office, run_experiment
from mapmerge_ros.experiments.consensus import Part, find_corrupt
from mapmerge_ros.experiments.corrupt_session import DamagedSession, damaged_session
from mapmerge_ros.experiments.fixed_transform import compress_held, merge_with_fixed_transform
from mapmerge_ros.experiments.office_site import COMMON, RECORDINGS
from mapmerge_ros.experiments.split import part_of, shared_ids, stretches
from mapmerge_ros.fusion import fuse
from mapmerge_ros.simulation import BehindCamera, adjust, paper_box


@pytest.fixture(scope='module')
def box_parts():
    """A clean session in six parts, and one more that saw some landmarks elsewhere."""
    bundle = paper_box(np.random.default_rng(3), maps=1, points=40, cameras=36, sigma=0.001)[0]
    rows = stretches(np.arange(36), 6)
    bundles = [adjust(part_of(bundle, own)) for own in rows]
    return [_part(own, each) for own, each in zip(rows, bundles, strict=True)]


def _part(rows, bundle):
    name = MapName(f'part{rows[0]:02d}', 'r', id_space='box')
    return Part(rows, compress(bundle, name, bundle.point_ids[:20], catalogue=False))


def _spoiled(part, ratio=0.05):
    """Return the part with five landmarks displaced: consistent in itself, unlike the others."""
    points = part.submap.points.copy()
    points[:5] += ratio * np.ptp(points, axis=0)
    return replace(part, submap=replace(part.submap, points=points))


def test_parts_share_landmarks_and_no_image():
    bundle = paper_box(np.random.default_rng(0), maps=1, points=30, cameras=8, seen_ratio=0.8)[0]
    parts = [part_of(bundle, rows) for rows in stretches(np.arange(8), 2)]
    ids = np.concatenate([part.keyframe_ids for part in parts])
    assert sorted(ids) == sorted(bundle.keyframe_ids)
    assert sum(len(part.observations_px) for part in parts) <= len(bundle.observations_px)
    assert len(shared_ids(parts)) > 20
    for part in parts:
        rows = part.observation_keyframes, part.observation_points
        assert np.bincount(rows[1]).min() >= 2
        keys = set(
            zip(
                *(
                    own.tolist()
                    for own in (
                        part.keyframe_ids[rows[0]],
                        part.point_ids[rows[1]],
                        part.observations_px[:, 0],
                    )
                ),
                strict=True,
            )
        )
        whole = set(
            zip(
                *(
                    own.tolist()
                    for own in (
                        bundle.keyframe_ids[bundle.observation_keyframes],
                        bundle.point_ids[bundle.observation_points],
                        bundle.observations_px[:, 0],
                    )
                ),
                strict=True,
            )
        )
        assert keys <= whole


def test_a_clean_session_is_kept_whole(box_parts):
    found = find_corrupt(box_parts, lambda part: (), corrupt.CONFIG)
    assert len(found.kept) == len(box_parts)
    assert not found.refused
    assert len(found.refused_rows) == 0
    assert found.fusion.verdict.accepted


@pytest.mark.parametrize(('at', 'ratio'), [(0, 0.05), (1, 0.05), (5, 0.05), (0, 0.5), (3, 0.5)])
def test_the_odd_part_is_named_wherever_it_is(box_parts, at, ratio):
    """Also when the merging begins with it, and when ids contradict the geometry outright."""
    parts = [_spoiled(part, ratio) if k == at else part for k, part in enumerate(box_parts)]
    found = find_corrupt(parts, lambda part: (), corrupt.CONFIG)
    assert [part.keyframe_rows[0] for part in found.refused] == [6 * at]
    assert found.fusion.verdict.accepted


def test_what_is_good_in_a_refused_part_is_saved(box_parts):
    whole = replace(_spoiled(box_parts[2]), keyframe_rows=np.arange(12, 24))
    parts = [*box_parts[:2], whole, *box_parts[4:]]

    def split(part):
        return [_spoiled(box_parts[2]), box_parts[3]] if part is whole else []

    found = find_corrupt(parts, split, corrupt.CONFIG)
    np.testing.assert_array_equal(found.refused_rows, np.arange(12, 18))
    assert len(found.kept) == 5


def test_a_part_without_a_map_is_refused(box_parts):
    lost = Part(np.arange(12, 18), None)
    parts = [*box_parts[:2], lost, *box_parts[3:]]
    found = find_corrupt(parts, lambda part: (), corrupt.CONFIG)
    assert found.refused == (lost,)


def test_all_parts_without_a_map_keep_nothing():
    found = find_corrupt([Part(np.arange(3), None)], lambda part: (), corrupt.CONFIG)
    assert not found.kept
    assert found.fusion.global_map is None


def test_the_fixed_transform_costs_more():
    maps = paper_box(np.random.default_rng(1), maps=2, points=30, sigma=0.005)
    names = [MapName(f'm{k}', 'r', id_space='box') for k in (0, 1)]
    ids = maps[0].point_ids[:15]
    held = [compress_held(own, name, ids) for own, name in zip(maps, names, strict=True)]
    joint = fuse(compress(o, n, ids, catalogue=False) for o, n in zip(maps, names, strict=True))
    assert merge_with_fixed_transform(*held) > joint.verdict.a_tilde
    with pytest.raises(DegenerateGeometry):
        merge_with_fixed_transform(held[0], compress_held(maps[1], names[1], ids[:-1]))


def test_bookshelf_refuses_the_moved_object():
    results = run_experiment(bookshelf.EXPERIMENT, runs=2, seed=1)
    summary = bookshelf.summarise(results)
    assert (results.column('p_joint')[:, bookshelf.CHANGED] < 1e-6).all()
    assert len(summary.tables[0].rows) == 4
    assert bookshelf.draw(results).axes


def test_office_has_the_sizes_of_the_paper():
    results = run_experiment(office.EXPERIMENT, runs=1)
    values = results.values[0]
    assert tuple(values['merge_size']) == (288, 100)
    assert tuple(values['full_size']) == (49600, 8997)
    assert len(values['ours']) == COMMON * (COMMON - 1) // 2
    summary = office.summarise(results)
    assert all(check.holds for check in summary.checks[1:])
    assert len(summary.tables[0].rows) == 5
    assert office.draw(results).axes


def test_office_recordings_are_those_of_the_table():
    _, bundles = office._site(0)
    for bundle, recording in zip(bundles, RECORDINGS, strict=True):
        assert bundle.residual_count == recording.residuals
        assert len(bundle.point_ids) == recording.points
        assert len(bundle.keyframe_ids) == recording.keyframes
    assert len(office.common_ids(bundles)) == COMMON


def test_corrupt_names_the_stretch():
    results = run_experiment(corrupt.EXPERIMENT, runs=1)
    assert results.values[0]['named']
    summary = corrupt.summarise(results)
    assert all(check.holds for check in summary.checks)
    assert corrupt.draw(results).axes


def test_the_damage_is_where_it_says():
    session: DamagedSession = damaged_session(np.random.default_rng(0))
    damage = session.damage
    wrong = np.isin(session.bundle.observation_keyframes, damage.keyframe_rows)
    wrong &= np.isin(session.bundle.observation_points, damage.landmark_rows)
    offset = np.linalg.norm(session.bundle.observations_px - session.truth.observations_px, axis=1)
    assert np.median(offset[wrong]) > 2.0
    assert np.median(offset[~wrong]) < 1.0


def test_every_point_of_the_box_is_seen_twice():
    box = paper_box(np.random.default_rng(0), maps=1, points=60, cameras=4, seen_ratio=0.3)[0]
    assert np.bincount(box.observation_points).min() >= 2


def test_office_records_again_where_a_point_ends_behind_a_camera(monkeypatch):
    taken = []

    def flown(seed, run, retake):
        taken.append(retake)
        if retake < 1:
            raise BehindCamera('bundle adjustment: point 7 is behind a camera')
        return {'accepted': True}

    monkeypatch.setattr(office, '_flown', flown)
    assert office.run_one(0, 0) == {'accepted': True, 'retakes': 1}
    assert taken == [0, 1]
