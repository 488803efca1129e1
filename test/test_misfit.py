# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""How badly one sub-map fits to what the others agree on."""

from __future__ import annotations

import numpy as np
import pytest
from gaussian_merges import merged, noise, scene

from mapmerge_ros.fusion import misfit
from mapmerge_ros.fusion.contrasts import contrasts
from mapmerge_ros.fusion.likelihood import weigh
from mapmerge_ros.fusion.misfit import MapTest, misfits, without_map, worst_map


def test_contrasts_without_a_map_are_those_of_the_others():
    """Price and freedom of the others do not depend on what the one that is left out says."""
    rng = np.random.default_rng(5)
    points, members, matrices = scene(rng, maps=4, landmarks=40, views=(2, 4))
    errors = noise(rng, points, members, matrices)
    disturbed = errors.copy()
    part = members.of_map(2)
    disturbed[part] += rng.normal(size=disturbed[part].shape)
    prices = []
    for own in (errors, disturbed):
        data = contrasts(merged(points, members, matrices, own), 600)
        rest = without_map(data, part)
        prices.append(weigh(rest, np.array([1.0, 0.1, 0.1])).price(rest))
        assert abs(rest.from_members[:, part]).sum() == 0.0
        identity = (rest.from_members @ rest.from_members.T).toarray()
        np.testing.assert_allclose(identity, np.eye(len(rest.tracks)), atol=1e-12)
    assert prices[0] == pytest.approx(prices[1], rel=1e-6)
    assert rest.dof == 3 * len(rest.tracks) - 14


def test_a_map_that_is_noisier_than_the_others_is_the_worst():
    ratios, found = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points, members, matrices = scene(rng, maps=4, landmarks=70, views=(3, 4))
        errors = noise(rng, points, members, matrices)
        ratios.append(worst_map(merged(points, members, matrices, errors)).ratio)
        errors[members.of_map(2)] *= 3.0
        found.append(worst_map(merged(points, members, matrices, errors)))
    assert max(ratios) < 1.3
    assert {test.k for test in found} == {2}
    assert not any(test.is_believed for test in found)


def test_each_map_is_tested_by_the_errors_of_the_others():
    rng = np.random.default_rng(1)
    points, members, matrices = scene(rng, maps=4, landmarks=70, views=(3, 4))
    errors = noise(rng, points, members, matrices)
    errors[members.of_map(1)] *= 3.0
    merge = merged(points, members, matrices, errors)
    found = misfits(merge, [3, 1, 0])
    assert [test.k for test in found] == [3, 1, 0]
    assert np.argmax([test.ratio for test in found]) == 1
    assert found[1] == worst_map(merge)


def test_a_map_of_few_landmarks_may_be_further_off_by_chance():
    def test(ratio, landmarks):
        return MapTest(0, ratio * (3 * landmarks - 7), 3 * landmarks - 7, landmarks)

    assert test(2.9, 10).is_believed
    assert not test(2.9, 200).is_believed
    assert test(2.2, 100_000).is_believed
    assert not test(2.3, 100_000).is_believed


def test_of_rivals_chance_is_as_large_as_their_landmarks_are_few():
    """The larger ratio is believed and the smaller is not: that one fits worse."""
    few, many = (
        MapTest(k, ratio * (3 * count - 7), 3 * count - 7, count)
        for k, ratio, count in ((0, 2.8, 10), (1, 2.7, 150))
    )
    assert few.ratio > many.ratio
    assert few.is_believed
    assert not many.is_believed
    assert few.excess < 1.0 < many.excess


def test_of_a_large_fleet_the_rivals_are_asked_wherever_the_sample_would_be(monkeypatch):
    """A sample of 150 contrasts is about 15 of 20 maps; some others are asked."""
    monkeypatch.setattr(misfit, 'MAX_CONTRASTS', 150)
    rng = np.random.default_rng(0)
    points, members, matrices = scene(rng, maps=20, landmarks=600, views=(2, 3))
    errors = noise(rng, points, members, matrices)
    plain = contrasts(merged(points, members, matrices, errors), 150)
    outside = np.setdiff1d(np.arange(20), members.maps[plain.owners >= 0])[:3]
    errors[members.of_map(int(outside[1]))] *= 3.0
    tests = misfits(merged(points, members, matrices, errors), outside)
    assert [test.k for test in tests] == outside.tolist()
    assert min(test.landmarks for test in tests) >= 20
    assert [test.is_believed for test in tests] == [True, False, True]


def test_of_two_maps_none_is_the_worst():
    rng = np.random.default_rng(3)
    points, members, matrices = scene(rng, maps=2, landmarks=70, views=(2, 2))
    errors = noise(rng, points, members, matrices)
    assert worst_map(merged(points, members, matrices, errors)) is None
