# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The pictures of the report: where points are drawn, and how motions are told."""

from __future__ import annotations

import base64
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapmerge_ros.fusion import Change, Fusion, Kind, fuse
from mapmerge_ros.geometry import Gauge, skew
from mapmerge_ros.io.change_words import motion
from mapmerge_ros.io.drawing import top_view
from mapmerge_ros.io.map_points import map_points
from mapmerge_ros.io.moved_objects import moved_objects
from mapmerge_ros.io.palette import colours, map_colours
from mapmerge_ros.io.scene import MAX_RADII, make_scene
from mapmerge_ros.io.scene_data import LANDMARK_BIT, SHARED_BIT, packed, scene_data

from reported import submaps  # isort: skip


@pytest.fixture(scope='module')
def fusion() -> Fusion:
    return fuse(submaps())


def unpacked(values: dict[str, Any]) -> np.ndarray[Any, np.dtype[Any]]:
    words = np.frombuffer(base64.b64decode(values['data']), '<u2').reshape(-1, 3)
    return np.array(values['low']) + words * np.array(values['step'])


COLOURS = map_colours({f'r{k}/0001': f'r{k}' for k in range(4)})


def test_scene_holds_every_point_twice(fusion: Fusion) -> None:
    scene = make_scene(fusion)
    data = scene_data(scene, fusion, COLOURS, [])
    owners = np.frombuffer(base64.b64decode(data['owners']), '<u2').astype(int)
    whole = map_points(fusion)
    total = sum(len(item.submap.points) for item in fusion.alignments)
    assert scene.total == total
    assert len(owners) > 0.9 * total  # strays are left out
    merged = unpacked(data['merged'])
    np.testing.assert_allclose(merged, scene.merged, atol=2e-4 * MAX_RADII)
    is_landmark = owners & LANDMARK_BIT > 0
    assert is_landmark.sum() == 2 * whole.landmark_count
    assert ((owners & SHARED_BIT > 0) >= is_landmark).all()
    for k in range(2):  # shared landmarks of both maps are at one place once merged
        rows = is_landmark & (owners & ~(SHARED_BIT | LANDMARK_BIT) == k)
        seen = np.sort(scene.viewpoint.points(whole.points_global[: whole.landmark_count]), axis=0)
        np.testing.assert_allclose(np.sort(merged[rows], axis=0), seen, atol=1e-3)
    assert [link[:2] for link in data['links']] == [[0, 1]]


def test_before_the_merge_sub_maps_are_as_sent(fusion: Fusion) -> None:
    """A similarity takes the drawn points to the sent ones, and cells do not touch."""
    scene = make_scene(fusion)
    boxes = []
    for k, item in enumerate(scene.alignments):
        drawn = scene.sent[scene.owners == k]
        if len(drawn) == len(item.submap.points):
            shifts = drawn - drawn[0], item.submap.points - item.submap.points[0]
            ratio = np.linalg.norm(shifts[0]) / np.linalg.norm(shifts[1])
            np.testing.assert_allclose(shifts[0], ratio * shifts[1], atol=1e-9)
        boxes.append(np.percentile(drawn[:, :2], [10, 90], axis=0))
    for a in range(len(boxes)):
        for b in range(a):
            low, high = np.maximum(boxes[a][0], boxes[b][0]), np.minimum(boxes[a][1], boxes[b][1])
            assert (low > high).any()


def test_lines_join_points_that_are_one_once_merged(fusion: Fusion) -> None:
    scene = make_scene(fusion)
    same = scene.same_points(1000)
    assert len(same) == scene.is_shared.sum() - len(np.unique(scene.slots[scene.is_shared]))
    assert (scene.owners[same[:, 0]] != scene.owners[same[:, 1]]).all()
    np.testing.assert_array_equal(scene.merged[same[:, 0]], scene.merged[same[:, 1]])
    assert len(scene.same_points(5)) == 5
    words = np.frombuffer(
        base64.b64decode(scene_data(scene, fusion, COLOURS, [])['matches']), '<u2'
    )
    np.testing.assert_array_equal(words.reshape(-1, 2), same)


def test_large_scene_is_thinned_evenly_and_keeps_landmarks(fusion: Fusion) -> None:
    whole, few = make_scene(fusion), make_scene(fusion, max_points=60)
    assert len(few.owners) == 60
    assert few.total == whole.total
    assert few.is_landmark.sum() == whole.is_landmark.sum()
    assert len(np.unique(few.owners)) == len(np.unique(whole.owners))


def test_packing_survives_one_point_and_none() -> None:
    for points in (np.zeros((0, 3)), np.full((1, 3), 7.0)):
        np.testing.assert_allclose(unpacked(packed(points)), points)


def test_colour_is_that_of_the_robot_unless_there_is_one_only() -> None:
    two = map_colours({'a/1': 'a', 'a/2': 'a', 'b/1': 'b'})
    assert two['a/1'] == two['a/2'] != two['b/1']
    assert len(set(map_colours({'a/1': 'a', 'a/2': 'a'}).values())) == 2


def test_drawing_stays_small_and_deterministic(fusion: Fusion) -> None:
    rng = np.random.default_rng(0)
    n = 50_000
    points = replace(
        map_points(fusion),
        points_global=rng.normal(size=(n, 3)) * [1.0, 1e3, 10.0],
        owners=rng.integers(-1, 2, n),
        views=np.ones(n, int),
        landmark_count=100,
    )
    drawn = top_view(points, Gauge.SIMILARITY, colours(2))
    assert drawn == top_view(points, Gauge.SIMILARITY, colours(2))
    assert len(drawn) < 150_000
    assert '</text>' not in drawn
    assert re.search(r'>\d+ m</text>', top_view(points, Gauge.RIGID, colours(2)))


def test_drawing_survives_one_point_and_lines(fusion: Fusion) -> None:
    whole = map_points(fusion)
    for flat in (np.zeros((len(whole), 3)), np.outer(np.arange(len(whole)), [1.0, 0, 0])):
        for gauge in Gauge:
            drawn = top_view(replace(whole, points_global=flat), gauge, colours(2))
            assert 'nan' not in drawn
            assert 'inf' not in drawn


SHIFT = np.array([0.3, 0.4, 0.0])


def changes_of(turn: float, count: int = 8, turn_std: float = 0.02) -> tuple[Change, ...]:
    """An object as the engine tells it: displacements of one motion, covariances from its own."""
    rng = np.random.default_rng(3)
    before = rng.normal(size=(count, 3))
    before -= before.mean(axis=0)
    arms = Rotation.from_rotvec([0.0, 0.0, turn]).apply(before)
    basis = np.concatenate([-skew(arms), np.broadcast_to(np.eye(3), (count, 3, 3))], axis=2)
    covariance = np.diag(np.repeat([turn_std**2, 1e-4], 3))
    covariances = basis @ covariance @ basis.swapaxes(1, 2)
    shifts = arms - before + SHIFT
    after = before + shifts
    return tuple(
        Change('m', 1, k, k, after[k], shifts[k], covariances[k], 1e-12, 1, Kind.MOVED)
        for k in range(count)
    )


def test_motion_of_an_object_in_words() -> None:
    (turned,) = moved_objects(changes_of(0.3))
    assert turned.turn_rad == pytest.approx(0.3)
    assert turned.distance == pytest.approx(0.5)
    assert turned.distance_std == pytest.approx(0.01)
    (straight,) = moved_objects(changes_of(0.0))
    assert straight.turn_rad == 0.0
    text = motion(turned, Gauge.YAW_TRANSLATION, 10.0)
    assert re.fullmatch(
        r'moved by 0\.5 ± 0\.02 m \(5\.0% of the radius of the scene\), level, '
        r'and turned by about 17°',
        text,
    )
    assert 'map units' in motion(straight, Gauge.SIMILARITY, 10.0)
    assert 'turned' not in motion(straight, Gauge.SIMILARITY, 10.0)


@pytest.mark.parametrize('count', [5, 6, 20])
def test_only_certain_turns_are_told(count: int) -> None:
    """0.1 rad is told where it is five standard deviations, not where it is two or unknown."""
    assert moved_objects(changes_of(0.1, count, 0.02))[0].turn_rad == pytest.approx(0.1)
    for turn_std in (0.05, 0.0):
        assert moved_objects(changes_of(0.1, count, turn_std))[0].turn_rad == 0.0
    assert moved_objects(changes_of(0.1, 4, 0.02))[0].turn_rad == 0.0
