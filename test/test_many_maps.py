# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of a large fleet are fitted to a part of it that still knows something of each map."""

import numpy as np
import pytest
from gaussian_merges import draw, merged, noise, scene

from mapmerge_ros.fusion.contrasts import contrasts
from mapmerge_ros.fusion.honest import examine
from mapmerge_ros.fusion.likelihood import weigh
from mapmerge_ros.fusion.sample import LEAST_OF_A_MAP
from mapmerge_ros.fusion.trimming import _together

NOISE = 1.4
"""Of the maps, over what they claim: φ is its square."""


def fleet(maps, seed):
    rng = np.random.default_rng(seed)
    points, members, matrices = scene(rng, maps=maps, landmarks=12 * maps, views=(2, 3))
    errors = NOISE * noise(rng, points, members, matrices)
    return merged(points, members, matrices, errors)


@pytest.mark.parametrize(('maps', 'seed'), [(40, 0), (40, 2), (70, 0)])
def test_a_large_fleet_is_believed_with_the_errors_that_it_has(maps, seed):
    found = examine(fleet(maps, seed), np.inf, certain=True)
    assert found.model is not None, 'left to the textbook'
    assert found.model.phi == pytest.approx(NOISE**2, rel=0.25)
    assert found.p_value > 0.01


def test_a_sample_of_a_large_fleet_is_about_some_maps():
    merge = fleet(30, 1)
    data = contrasts(merge, 12 * LEAST_OF_A_MAP)
    maps = np.unique(merge.members.maps[data.owners >= 0])
    assert len(maps) == 12
    # What they share with others is not in it, and frames of all of them are explained.
    outside = np.isin(merge.members.maps, maps, invert=True)
    assert not np.isin(data.tracks, merge.members.tracks[outside]).any()
    for k in maps:
        spread = np.kron(data.from_members.toarray(), np.eye(3))
        part = merge.members.of_map(int(k))
        moved = spread[:, 3 * part.start : 3 * part.stop] @ merge.frames(int(k))
        left = moved - data.frames @ (data.frames.T @ moved)
        assert np.abs(left).max() < 1e-9 * np.abs(moved).max()


def test_suspects_are_in_the_sample_of_a_large_fleet():
    merge = fleet(30, 1)
    suspects = np.flatnonzero(merge.members.maps == 17)[:5]
    data = contrasts(merge, 12 * LEAST_OF_A_MAP, suspects)
    assert 17 in merge.members.maps[data.owners >= 0]


def test_of_a_map_that_its_frame_explains_nobody_is_set_aside():
    merge = draw(3, maps=5, landmarks=40)
    data = contrasts(merge, 600)
    weighing = weigh(data, np.array([1.0, 0.0, 0.0]))
    own = np.flatnonzero(merge.members.maps == 2)
    kept = _together(data, weighing, own)
    # A similarity is held by two landmarks and a third: three stay, or two and a bit.
    assert len(own) - 3 <= len(kept) < len(own)
    np.linalg.cholesky(weighing.seen(data.columns(kept)) @ data.columns(kept))
    some = own[:4]
    np.testing.assert_array_equal(_together(data, weighing, some), some)
