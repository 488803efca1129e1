# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames composed along the paths that are to be relied on."""

from __future__ import annotations

import numpy as np

from mapmerge_ros.geometry import FrameGraph, Gauge, Similarity, scene_radius
from mapmerge_ros.simulation import random_frame


def chain(rng, wrong=None):
    """Frames in a ring of five, a sixth alone; the pair `wrong` is off."""
    S_world_k = [random_frame(rng, Gauge.SIMILARITY) for _ in range(6)]
    pairs = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 4)]
    known = {(a, b): S_world_k[a].inverse() @ S_world_k[b] for a, b in pairs}
    if wrong:
        known[wrong] = known[wrong] @ Similarity.exp(np.ones(7))
    return S_world_k, FrameGraph(6, known, [9.0 if pair == wrong else 1.0 for pair in pairs])


def test_frames_are_composed_from_any_root():
    S_world_k, graph = chain(np.random.default_rng(0))
    for root in range(5):
        frames = graph.frames_from(root)
        assert set(frames) == set(range(5))
        for k, S_root_k in frames.items():
            apart = S_root_k.inverse() @ (S_world_k[root].inverse() @ S_world_k[k])
            assert np.abs(apart.log()).max() < 1e-9


def test_long_pairs_are_walked_last():
    S_world_k, graph = chain(np.random.default_rng(1), wrong=(0, 4))
    apart = graph.frames_from(0)[4].inverse() @ (S_world_k[0].inverse() @ S_world_k[4])
    assert np.abs(apart.log()).max() < 1e-9


def test_what_no_pair_connects_is_apart():
    _, graph = chain(np.random.default_rng(2))
    assert graph.components() == ((0, 1, 2, 3, 4), (5,))
    assert FrameGraph(0, {}, []).components() == ()
    assert set(graph.frames_from(5)) == {5}


def test_the_centre_is_nearest_to_all_of_those_that_may_be_it():
    path = {(k, k + 1): Similarity.identity() for k in range(4)}
    graph = FrameGraph(5, path, [1.0] * 4)
    assert graph.centre(range(5), range(5)) == 2
    assert graph.centre([4, 0, 1], range(5)) == 1


def test_the_radius_of_a_scene_does_not_follow_a_far_point():
    points = np.random.default_rng(3).normal(size=(400, 3))
    far = np.vstack([points, [[1e6, 0.0, 0.0]]])
    assert abs(scene_radius(far) / scene_radius(points) - 1.0) < 0.02
    assert np.isclose(scene_radius(3.0 * points + 7.0), 3.0 * scene_radius(points))
