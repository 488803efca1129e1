# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""One robot with other residuals than the others neither hides what is wrong nor goes untold."""

from dataclasses import replace

import numpy as np
import pytest
from ros_processes import SHIPPED

from mapmerge_ros.fusion import fuse
from mapmerge_ros.fusion.noise import UNLIKE, noise_notes, pool_noise
from mapmerge_ros.io import read_submaps


@pytest.fixture(scope='module')
def submaps():
    """Four drones that do not know their σ."""
    newest = {item.submap.map_id: item.submap for item in read_submaps(SHIPPED)}
    return tuple(replace(newest[name], sigma=0.0) for name in sorted(newest))


def bent(submap, share=0.1):
    """A map whose ends rise by a share of half its length."""
    points = submap.points.copy()
    along = points[:, 0] - points[:, 0].mean()
    half = np.abs(along).max()
    points[:, 2] += share * half * (along / half) ** 2
    return replace(submap, points=points)


def test_sub_maps_that_are_alike_have_one_noise(submaps):
    noise = pool_noise(submaps)
    total = sum(submap.a**2 for submap in submaps)
    redundancy = sum(submap.redundancy for submap in submaps)
    assert noise.sigma == pytest.approx(np.sqrt(total / redundancy))
    assert noise.estimated_from == redundancy
    np.testing.assert_allclose(noise.weights, 1.0)
    assert noise_notes(submaps) == {}


@pytest.mark.parametrize('factor', [1.5, 5.0, 0.1])
def test_who_is_unlike_the_others_counts_for_itself(submaps, factor):
    odd = replace(submaps[1], a=factor * submaps[1].a)
    found = (submaps[0], odd, *submaps[2:])
    noise, notes = pool_noise(found), noise_notes(found)
    ratios = noise.weights / noise.weights[0]
    if 1.0 / UNLIKE < factor < UNLIKE:
        np.testing.assert_allclose(ratios, 1.0)
        assert notes == {}
        return
    np.testing.assert_allclose(ratios[[0, 2, 3]], 1.0)
    assert ratios[1] == pytest.approx(factor**-2, rel=0.1)
    assert list(notes) == [odd.map_id]
    assert f'counts for {"less" if factor > 1 else "more"}' in notes[odd.map_id]


@pytest.mark.parametrize('factor', [10.0, 100.0])
def test_noise_of_one_does_not_hide_that_another_is_bent(submaps, factor):
    odd = replace(submaps[1], a=factor * submaps[1].a)
    fusion = fuse((submaps[0], odd, bent(submaps[2]), submaps[3]))
    kept_out = [item.submap.map_id for item in fusion.quarantined]
    assert kept_out == [submaps[2].map_id]
    (noted,) = [item for item in fusion.alignments if item.note]
    assert noted.submap.map_id == odd.map_id


def test_a_claim_that_the_residuals_contradict_is_told(submaps):
    for claim, word in ((0.05, 'too much'), (5.0, 'too little')):
        notes = noise_notes([replace(submaps[0], sigma=claim), *submaps[1:]])
        assert list(notes) == [submaps[0].map_id]
        assert word in notes[submaps[0].map_id]
    assert noise_notes([replace(submaps[0], sigma=1.0), *submaps[1:]]) == {}


def test_without_noise_nobody_is_unlike(submaps):
    exact = [replace(submap, a=10.0**-k * 1e-9) for k, submap in enumerate(submaps)]
    np.testing.assert_allclose(pool_noise(exact).weights, 1.0)
    assert noise_notes(exact) == {}
