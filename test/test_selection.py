# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Good tracks: the best of every area, honest statistics, no price where the noise is Gaussian."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import random_bundle

from mapmerge_ros.bundle.quality import TrackQuality, good_tracks, track_variances
from mapmerge_ros.bundle.selection import best_tracks, matched

QUALITY = TrackQuality()


def with_bad_tracks(bundle, rows, shift_px, seed=0):
    """The same bundle with all observations of some points far off."""
    rng = np.random.default_rng(seed)
    bad = np.isin(bundle.observation_points, rows)
    noise_px = shift_px * rng.normal(size=bundle.observations_px.shape) * bad[:, None]
    return replace(bundle, observations_px=bundle.observations_px + noise_px)


def test_scattered_bad_tracks_are_not_chosen():
    plain = random_bundle(1, points=200)
    bad_rows = np.random.default_rng(1).choice(200, 30, replace=False)
    bundle = with_bad_tracks(plain, bad_rows, 8.0)
    chosen = matched([bundle, plain], quality=QUALITY)
    np.testing.assert_array_equal(chosen[0], chosen[1])  # nothing is chosen for one alone
    among = np.isin(bundle.point_ids[bad_rows], chosen[0])
    assert among.sum() <= 1
    assert len(chosen[0]) > 70
    best = best_tracks(bundle, 100, QUALITY)
    assert np.isin(bundle.point_ids[bad_rows], best).sum() <= 1
    assert len(best_tracks(bundle, 190, QUALITY)) == 190


def test_a_bad_area_keeps_its_best():
    plain = random_bundle(2, points=200)
    corner = np.argsort(plain.points[:, 0])[:60]
    bundle = with_bad_tracks(plain, corner, 8.0)
    rows = np.arange(200)
    good = good_tracks(bundle, rows, QUALITY)
    variances = track_variances(bundle)
    assert 15 <= good[corner].sum() <= 30  # about a third
    assert good.sum() > 120
    kept, dropped = corner[good[corner]], corner[~good[corner]]
    assert np.median(variances[kept]) < 0.7 * np.median(variances[dropped])
    global_cut = replace(QUALITY, best_of_area=0)
    assert good_tracks(bundle, rows, global_cut)[corner].sum() <= 3


def test_few_candidates_are_all_kept():
    bundle = random_bundle(3)
    assert good_tracks(bundle, np.arange(4), QUALITY).all()
    assert len(good_tracks(bundle, np.arange(0), QUALITY)) == 0


def test_quality_does_not_depend_on_the_frame():
    from mapmerge_ros.geometry import Similarity

    bundle = random_bundle(4, points=100)
    moved = bundle.transformed(Similarity.exp(np.random.default_rng(4).normal(size=7)))
    rows = np.arange(100)
    np.testing.assert_array_equal(
        good_tracks(bundle, rows, QUALITY), good_tracks(moved, rows, QUALITY)
    )
