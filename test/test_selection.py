# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Good tracks: the best of every area, honest statistics, no price where the noise is Gaussian."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import random_bundle

from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.bundle.linearise import linearise
from mapmerge_ros.bundle.quality import (
    TrackQuality,
    TrackResiduals,
    claimed_variances,
    good_tracks,
)
from mapmerge_ros.bundle.selection import best_tracks, matched
from mapmerge_ros.fusion import fuse

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
    variances = TrackResiduals.of(linearise(bundle)).variances(QUALITY.prior_redundancy)
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


def test_gaussian_sessions_keep_every_track():
    bundle = random_bundle(5, points=200)
    lin = linearise(bundle)
    assert 0.8 < TrackResiduals.of(lin).tail_ratio < QUALITY.gaussian_tail_ratio
    assert good_tracks(bundle, np.arange(200), QUALITY).all()
    np.testing.assert_array_equal(claimed_variances(lin, 0.3), np.full(200, 0.3))


def test_a_point_that_its_own_session_sees_badly_is_announced_as_less_sure():
    bundle = with_bad_tracks(random_bundle(5, points=200), np.arange(30), 8.0)
    lin = linearise(bundle)
    assert TrackResiduals.of(lin).tail_ratio > 2.0
    pooled = lin.cost_px2 / (bundle.residual_count - bundle.dof)
    claimed = claimed_variances(lin, pooled)
    assert claimed.max() <= pooled
    assert np.median(claimed[:30]) == pooled
    assert np.median(claimed[30:]) < 0.6 * pooled


@pytest.fixture(scope='module')
def fleets():
    pytest.importorskip('pycolmap', reason='sessions are bundled by Ceres')
    from mapmerge_ros.simulation import FleetConfig, simulate_fleet

    return [simulate_fleet(FleetConfig(descriptors=False), seed) for seed in range(4)]


def variance_factor(bundles, chosen):
    submaps = [
        compress(bundle, MapName(f'drone{k}', 'drone', id_space='fleet'), ids, catalogue=False)
        for k, (bundle, ids) in enumerate(zip(bundles, chosen, strict=True))
    ]
    fusion = fuse(submaps)
    assert len(fusion.components[0].map_ids) == len(bundles)
    return fusion.components[0].verdict.variance_factor


def test_choosing_by_residuals_does_not_bias_the_merge_of_gaussian_sessions(fleets):
    """Truncated residuals, honest statistics: they are independent of the points."""
    always = replace(QUALITY, gaussian_tail_ratio=0.0)
    factors, kept, before = [], 0, 0
    for fleet in fleets:
        chosen = matched(fleet.bundles, quality=always)
        kept += sum(map(len, chosen))
        before += sum(map(len, matched(fleet.bundles)))
        factors.append(variance_factor(fleet.bundles, chosen))
    assert kept < 0.6 * before
    # 24 fleets: mean 1.002, standard deviation of one 0.09.
    assert np.mean(factors) == pytest.approx(1.0, abs=0.13)


def test_bad_tracks_spoil_a_merge_unless_good_ones_are_chosen(fleets):
    """A sixth of each session's tracks on wrong key points, five sigma off."""
    from mapmerge_ros.simulation import adjust

    for seed, fleet in enumerate(fleets[:2]):
        bundles = []
        for bundle in fleet.bundles:
            bad = np.random.default_rng(seed).permutation(len(bundle.points))[::6]
            bundles.append(adjust(with_bad_tracks(bundle, bad, 2.5, seed)))
        spoilt = variance_factor(bundles, matched(bundles))
        chosen = matched(bundles, quality=QUALITY)
        assert spoilt > 2.0
        assert variance_factor(bundles, chosen) < 0.6 * spoilt


def test_matched_points_are_those_that_others_have() -> None:
    first, second = random_bundle(seed=1), random_bundle(seed=2)
    third = replace(random_bundle(seed=3), point_ids=np.arange(30) + 10**6)
    chosen = matched([first, second, third])
    np.testing.assert_array_equal(chosen[0], np.sort(first.point_ids))
    np.testing.assert_array_equal(chosen[0], chosen[1])
    assert len(chosen[2]) == 0


def test_capped_match_takes_what_most_bundles_have_and_never_one_alone() -> None:
    first = random_bundle(seed=1)
    second = replace(random_bundle(seed=2), point_ids=first.point_ids)
    third_ids = first.point_ids.copy()
    third_ids[:20] += 10**6
    third = replace(random_bundle(seed=3), point_ids=third_ids)
    chosen = matched([first, second, third], 12)
    assert [len(ids) for ids in chosen] == [12, 12, 10]
    assert set(first.point_ids[20:]) <= set(chosen[0])
    counts = np.unique(np.concatenate(chosen), return_counts=True)[1]
    assert (counts >= 2).all()


def test_best_tracks_are_the_longest() -> None:
    bundle = random_bundle(seed=4)
    lengths = dict(
        zip(bundle.point_ids.tolist(), np.bincount(bundle.observation_points), strict=True)
    )
    best = best_tracks(bundle, 10)
    shortest = min(lengths[own] for own in best.tolist())
    others = set(lengths) - set(best.tolist())
    assert len(best) == 10
    assert all(lengths[own] <= shortest for own in others)
