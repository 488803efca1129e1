# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The joint merge: invariances, the oracle, hierarchy, and the calibration of its test."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from test_geometry import random_similarity

from mapmerge_ros.bundle import MapName, compress
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import FusionConfig, fuse
from mapmerge_ros.fusion.element import Element
from mapmerge_ros.fusion.region import p_value_of
from mapmerge_ros.geometry import Gauge, align
from mapmerge_ros.submap import alignment_weights

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.simulation import (
    FleetConfig,
    Sensing,
    box_truth,
    measured,
    paper_box,
    simulate_fleet,
)

GAUGES = [Gauge.SIMILARITY, Gauge.RIGID, Gauge.YAW_TRANSLATION, Gauge.NONE]


def fleet_maps(seed=0, gauge=Gauge.SIMILARITY, sigma_px=0.5, **settings):
    config = FleetConfig(sensing=Sensing(gauge=gauge, sigma_px=sigma_px), **settings)
    return simulate_fleet(config, seed).submaps()


def shape_difference(fusion, other):
    """Largest distance of two maps after a similarity, in scene radii."""
    a, b = fusion.components[0].landmarks, other.components[0].landmarks
    np.testing.assert_array_equal(a.ids, b.ids)
    S = align(a.points_global, b.points_global).S_target_source
    distances = np.linalg.norm(S.apply(b.points_global) - a.points_global, axis=1)
    centred = a.points_global - np.median(a.points_global, axis=0)
    return distances.max() / np.median(np.linalg.norm(centred, axis=1))


def assert_same_map(fusion, other):
    assert shape_difference(fusion, other) < 1e-6
    np.testing.assert_allclose(other.verdict.a_tilde, fusion.verdict.a_tilde, rtol=1e-6)
    assert other.verdict.dof == fusion.verdict.dof


@pytest.mark.parametrize('gauge', GAUGES)
def test_the_order_of_arrival_leaves_no_trace(gauge):
    submaps = fleet_maps(1, gauge)
    first, other = fuse(submaps), fuse([submaps[k] for k in (2, 0, 3, 1)])
    np.testing.assert_array_equal(other.global_map.points, first.global_map.points)
    np.testing.assert_array_equal(other.global_map.packed_r, first.global_map.packed_r)
    assert other.verdict == first.verdict


@pytest.mark.parametrize('gauge', GAUGES)
def test_frame_and_scale_of_each_map_do_not_matter(gauge):
    submaps, rng = fleet_maps(2, gauge), np.random.default_rng(2)
    moved = [submap.transformed(random_similarity(rng, gauge, size=2.0)) for submap in submaps]
    assert_same_map(fuse(submaps), fuse(moved))


@pytest.mark.parametrize('first', range(4))
def test_which_map_is_called_first_does_not_matter(first):
    submaps = fleet_maps(3)
    renamed = [
        replace(submap, map_id=f'{(k - first) % 4}', stamp_ns=(k - first) % 4)
        for k, submap in enumerate(submaps)
    ]
    fusion = fuse(renamed)
    assert fusion.components[0].anchor == '0'
    assert_same_map(fuse(submaps), fusion)
    held = next(item for item in fusion.alignments if item.submap.map_id == '0')
    np.testing.assert_allclose(held.S_global_map.log(), 0.0, atol=1e-9)


@pytest.mark.parametrize('gauge', GAUGES)
def test_the_derivative_of_an_element_is_right(gauge):
    """Gradient against differences of the cost; matrix against differences of the residual."""
    submap = fleet_maps(4, gauge)[0]
    rng, count = np.random.default_rng(4), submap.compressed_count
    shared = rng.random(count) < 0.8
    element = Element.from_submap(submap, np.arange(count), shared, 1.7)
    points = (
        random_similarity(rng, gauge)
        .inverse()
        .apply(submap.compressed_points + 0.05 * rng.normal(size=(count, 3)))
    )
    matrix, gradient = element.derivatives(element.place(points))
    direction = rng.normal(size=(count, 3))
    step = 1e-5

    def residuals(amount):
        return element.residuals(element.place(points + amount * direction))

    slope = (residuals(step) - residuals(-step)) / (2 * step)
    np.testing.assert_allclose(gradient @ direction.ravel(), slope @ residuals(0.0), rtol=1e-6)
    np.testing.assert_allclose(
        direction.ravel() @ matrix @ direction.ravel(), slope @ slope, rtol=1e-6
    )


def oracle(submaps):
    """Merge of similarity maps as plainly as it can be written: scipy on all landmarks."""
    ids, slots = np.unique(
        np.concatenate([s.compressed_ids for s in submaps]), return_inverse=True
    )
    rows = np.split(slots, np.cumsum([s.compressed_count for s in submaps])[:-1])
    views = np.bincount(slots)

    def placed(submap, own, points):
        weights = alignment_weights(submap.triangle()) * (views[own] > 1)
        weights = weights / weights.sum()
        target, source = submap.compressed_points, points[own]
        centred, moving = target - weights @ target, source - weights @ source
        u, _, vt = np.linalg.svd((weights[:, None] * centred).T @ moving)
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        turned = moving @ rotation.T
        scale = weights @ np.sum(centred**2, axis=1) / (weights @ np.sum(centred * turned, axis=1))
        return scale * turned + weights @ target

    def residuals(flat):
        points = flat.reshape(-1, 3)
        return np.concatenate(
            [
                s.triangle() @ (placed(s, own, points) - s.compressed_points).ravel() + s.c
                for s, own in zip(submaps, rows, strict=True)
            ]
        )

    start = fuse(submaps).components[0].landmarks
    assert np.array_equal(start.ids, ids)
    blurred = start.points_global + 1e-3 * np.random.default_rng(0).normal(size=(len(ids), 3))
    found = scipy.optimize.least_squares(residuals, blurred.ravel(), xtol=1e-15, ftol=1e-15)
    return found.x.reshape(-1, 3), 2 * found.cost


def test_the_merge_finds_what_a_plain_optimiser_finds():
    bundles = paper_box(np.random.default_rng(5), sigma=0.05)
    submaps = [
        compress(bundle, MapName(f'map{k}', 'r', id_space='box'), bundle.point_ids[4 * k :][:14])
        for k, bundle in enumerate(bundles)
    ]  # 14 landmarks each, shared by 2 or 3 maps or private
    fusion = fuse(submaps)
    assert len(fusion.components[0].map_ids) == 3
    points, a_tilde = oracle(submaps)
    merged = fusion.components[0].landmarks.points_global
    moved = align(merged, points).S_target_source.apply(points)
    np.testing.assert_allclose(fusion.verdict.a_tilde, a_tilde, rtol=1e-8)
    assert np.abs(moved - merged).max() < 1e-5 * np.abs(merged - merged.mean(axis=0)).max()


def stacking_error(submaps, gauge=Gauge.SIMILARITY):
    """Distance of merge(merge(A, B), merge(C, D)) to merge(A, B, C, D), in standard deviations."""
    keep = {'max_landmarks': 10_000}
    everything = fuse(submaps, FusionConfig(**keep))
    halves = [
        fuse(pair, FusionConfig(map_id=f'half/{k}', **keep)).global_map
        for k, pair in enumerate((submaps[:2], submaps[2:]))
    ]
    stacked = fuse(halves, FusionConfig(**keep))
    assert stacked.global_map.sources == everything.global_map.sources
    assert stacked.global_map.residual_count == everything.global_map.residual_count
    assert stacked.global_map.dof == everything.global_map.dof
    np.testing.assert_allclose(stacked.global_map.a, everything.global_map.a, rtol=2e-3)
    a, b = everything.components[0].landmarks, stacked.components[0].landmarks
    np.testing.assert_array_equal(a.ids, b.ids)
    np.testing.assert_allclose(b.std, a.std, rtol=0.03)
    S = align(a.points_global, b.points_global, gauge=gauge).S_target_source
    distances = np.linalg.norm(S.apply(b.points_global) - a.points_global, axis=1)
    return distances / np.linalg.norm(a.std, axis=1)


@pytest.mark.parametrize('seed', range(5))
def test_a_merge_of_merges_is_the_merge_of_all(seed):
    """To 1 % of the landmarks' own standard deviation: each one, and at large noise their RMS."""
    for sigma, error in ((0.005, np.max), (0.05, lambda errors: np.sqrt(np.mean(errors**2)))):
        submaps = box_submaps(np.random.default_rng(seed), sigma, known=False, maps=4)
        assert error(stacking_error(submaps)) < 0.01


@pytest.mark.parametrize('gauge', GAUGES)
def test_stacking_is_exact_to_second_order(gauge):
    """Chains of drones that share only borders bend: the worst case. Half the noise, half."""
    errors = [
        np.median(stacking_error(fleet_maps(6, gauge, sigma_px=sigma_px), gauge))
        for sigma_px in (0.5, 0.25)
    ]
    assert errors[0] < (0.03 if gauge is Gauge.SIMILARITY else 0.01)
    assert errors[1] < 0.65 * errors[0] or errors[0] < 2e-3


def test_dropping_landmarks_from_the_outgoing_map_loses_nothing_about_the_others():
    submaps = fleet_maps(7)
    full = fuse(submaps, FusionConfig(max_landmarks=10_000)).global_map
    small = fuse(submaps, FusionConfig(max_landmarks=20)).global_map
    assert small.compressed_count == 20
    assert len(small.landmark_ids) == len(full.landmark_ids)
    r, s = full.triangle(), small.triangle()
    slots = np.searchsorted(full.compressed_ids, small.compressed_ids)
    others = np.setdiff1d(np.arange(full.compressed_count), slots)
    column = lambda rows: (3 * rows[:, None] + np.arange(3)).ravel()  # noqa: E731
    h = r.T @ r
    inner = h[np.ix_(column(others), column(others))]
    across = h[np.ix_(column(others), column(slots))]
    schur = h[np.ix_(column(slots), column(slots))] - across.T @ np.linalg.solve(inner, across)
    np.testing.assert_allclose(
        s.T @ s / np.abs(schur).max(), schur / np.abs(schur).max(), atol=1e-8
    )


def box_submaps(rng, sigma, known=True, maps=3):
    """Experiment 5.A.1 of the paper: three maps of a box, ten of 100 points in q."""
    return box_submaps_of(paper_box(rng, sigma=sigma, maps=maps), sigma, known)


def box_submaps_of(bundles, sigma, known):
    return [
        compress(
            replace(bundle, sigma_px=sigma if known else 0.0),
            MapName(f'map{k}', f'map{k}', id_space='box'),
            bundle.point_ids[:10],
            catalogue=False,
        )
        for k, bundle in enumerate(bundles)
    ]


@pytest.mark.parametrize('known', [True, False])
def test_the_price_of_merging_follows_the_paper(known):
    """5.A.1 at σ = 0.05, 200 runs: mean ã/σ² within 2 % of dof = 46, p-values uniform."""
    verdicts = [
        fuse(box_submaps(np.random.default_rng([7, run]), 0.05, known)).verdict
        for run in range(200)
    ]
    assert {verdict.dof for verdict in verdicts} == {46}
    ratio = np.mean([verdict.variance_factor for verdict in verdicts])
    assert abs(ratio - 1.0) < 0.02
    assert scipy.stats.kstest([v.p_value for v in verdicts], 'uniform').pvalue > 0.01


@pytest.mark.parametrize('gauge', GAUGES)
def test_metric_maps_keep_their_scale(gauge):
    """The mean of the maps' own scales comes out, though only a weak row of R holds it."""
    if gauge is Gauge.SIMILARITY:
        pytest.skip('a monocular map has no scale to keep')
    offsets = []
    for seed in range(10):
        fleet = simulate_fleet(FleetConfig(sensing=Sensing(gauge=gauge)), seed)
        landmarks = fuse(fleet.submaps()).components[0].landmarks
        S_world_global = align(
            fleet.truth.points_world(landmarks.ids), landmarks.points_global
        ).S_target_source
        own = np.mean([np.log(S_world_map.scale) for S_world_map in fleet.truth.S_world_map])
        offsets.append(np.log(S_world_global.scale) - own)
    assert abs(np.mean(offsets)) < 0.001  # the prior of a map is 1 %


def test_a_moved_object_makes_the_test_refuse():
    still, moved = fleet_maps(8), fleet_maps(8, moved=1)
    assert fuse(still).verdict.accepted
    verdict = fuse(moved, FusionConfig(unlock=False)).verdict
    assert not verdict.accepted
    assert 'costs' in verdict.reason


@pytest.mark.parametrize('known', [True, False])
def test_the_truth_lies_in_the_region_as_often_as_it_says(known):
    """The paper's box at 1/10 of its noise: p-values of the truth are uniform over noise."""
    truth = box_truth(np.random.default_rng(3))
    p_values = []
    for run in range(60):
        bundles = measured(truth, np.random.default_rng([3, run]), 0.005)
        fusion = fuse(box_submaps_of(bundles, 0.005, known))
        ids = fusion.components[0].landmarks.ids
        p_values.append(
            p_value_of(fusion, ids[::-1], truth[0].points[truth[0].rows_of(ids)][::-1])
        )
    assert scipy.stats.kstest(p_values, 'uniform').pvalue > 0.01


def test_the_region_needs_a_merge_and_all_its_landmarks():
    fusion = fuse(fleet_maps(9))
    landmarks = fusion.components[0].landmarks
    own = p_value_of(fusion, landmarks.ids, landmarks.points_global)
    assert own == pytest.approx(1.0, abs=1e-6)
    moved = random_similarity(np.random.default_rng(9)).apply(landmarks.points_global)
    assert p_value_of(fusion, landmarks.ids, moved) == pytest.approx(1.0, abs=1e-6)
    shaken = moved + np.random.default_rng(9).normal(size=moved.shape)
    assert p_value_of(fusion, landmarks.ids, shaken) < 1e-6
    with pytest.raises(InvalidValue, match='missing'):
        p_value_of(fusion, landmarks.ids[1:], landmarks.points_global[1:])
    with pytest.raises(InvalidValue, match='nothing is merged'):
        p_value_of(fuse([]), landmarks.ids, landmarks.points_global)
