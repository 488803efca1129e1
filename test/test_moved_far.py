# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What moved so far that its ids contradict everything else is told all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.fusion import Kind, fuse
from mapmerge_ros.fusion.moved_far import MIN_MEMBERS, _Displaced, _Member, _moved_as_one
from mapmerge_ros.geometry import align
from mapmerge_ros.simulation import FleetConfig, simulate_fleet

CONFIG = FleetConfig(drones=4, moved=1, moved_distance=3.0)


def scale_of(fusion, fleet):
    """World over global, from landmarks that are in several maps."""
    landmarks = fusion.components[0].landmarks
    known = np.isin(landmarks.ids, fleet.truth.scene.ids)
    known &= ~np.isin(landmarks.ids, fleet.truth.moved[0].landmark_ids)
    truth = fleet.truth.points_world(landmarks.ids[known])
    return align(truth, landmarks.points_global[known]).S_target_source.scale


@pytest.mark.parametrize('seed', (1, 2, 4, 5))
def test_it_is_one_object_with_its_displacement(seed):
    fleet = simulate_fleet(CONFIG, seed)
    fusion = fuse(fleet.submaps())
    assert fusion.contradictions
    moved = [change for change in fusion.changes if change.kind is Kind.MOVED]
    assert {change.object_id for change in moved} == {1}
    assert {change.landmark_id for change in moved} <= set(
        map(int, fleet.truth.moved[0].landmark_ids)
    )
    shifts = np.array([change.displacement_global for change in moved])
    lengths = scale_of(fusion, fleet) * np.linalg.norm(shifts, axis=1)
    np.testing.assert_allclose(lengths, 3.0, rtol=0.1)
    assert max(change.p_value for change in moved) < 1e-12
    assert fusion.verdict.accepted


def displaced(before, after, std=0.01):
    return [
        _Displaced(_Member(0, k, k, there, 0.0), k, there - here, std**2, 1.0)
        for k, (here, there) in enumerate(zip(before, after, strict=True))
    ]


@pytest.mark.parametrize('seed', range(5))
def test_what_moves_as_one_is_rigid(seed):
    """A body that went far and turned, among wrong ids that go anywhere in the scene."""
    rng = np.random.default_rng(seed)
    body = 0.6 * rng.normal(size=(8, 3))
    turn = Rotation.from_rotvec(0.5 * rng.normal(size=3) / np.sqrt(3.0))
    after = turn.apply(body) + [9.0, 4.0, 0.0] + 0.01 * rng.normal(size=body.shape)
    wrong = 3.0 * rng.normal(size=(40, 3))
    groups = _moved_as_one(
        displaced(np.vstack([body, wrong]), np.vstack([after, np.roll(wrong, 7, axis=0)])), 2.0
    )
    large = [{x.track for x in group} for group in groups if len(group) >= MIN_MEMBERS]
    assert large == [set(range(8))]
    assert sum(map(len, groups)) == 48
    assert _moved_as_one([], 2.0) == []


def test_ids_given_twice_are_no_object():
    """Four ids of one map at random other places: doubtful, each for itself."""
    fleet = simulate_fleet(replace(CONFIG, moved=0), 1)
    submaps = list(fleet.submaps())
    shared = np.intersect1d(submaps[0].compressed_ids, submaps[1].compressed_ids)
    ids = submaps[0].landmark_ids.copy()
    rows = np.flatnonzero(np.isin(ids, shared))
    spread = rows[np.argsort(submaps[0].points[rows, 0])][:: max(len(rows) // 4, 1)][:4]
    ids[spread] = ids[np.roll(spread, 1)]
    submaps[0] = replace(submaps[0], landmark_ids=ids)
    fusion = fuse(submaps)
    wrong = set(map(int, ids[spread]))
    told = {change.landmark_id for change in fusion.changes}
    assert told & wrong
    assert all(change.kind is Kind.DOUBTFUL for change in fusion.changes)
    assert fusion.verdict.accepted


def test_nothing_is_told_where_ids_are_right():
    fusion = fuse(simulate_fleet(replace(CONFIG, moved=0), 2).submaps())
    assert not fusion.contradictions
    assert not [change for change in fusion.changes if change.kind is Kind.MOVED]
