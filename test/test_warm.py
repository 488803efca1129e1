# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A fusion that goes on from the last one says what one from scratch says."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip('pycolmap', reason='simulated maps are bundled by Ceres: pip install pycolmap')

from mapmerge_ros.fusion import FusionConfig, FusionEngine, Warm, fuse
from mapmerge_ros.fusion.associate import associate_by_id
from mapmerge_ros.fusion.joint import minimise as joint
from mapmerge_ros.fusion.joint import resume as resuming
from mapmerge_ros.fusion.links import find_links
from mapmerge_ros.geometry import Gauge, align
from mapmerge_ros.simulation import FleetConfig, Sensing, simulate_fleet

SETTINGS = {'drones': 6, 'keyframes': 16, 'landmarks': 140}
SHARP = FusionConfig(convergence=1e-6)
"""What is left of the last step is rounding."""

GAUGES = [Gauge.SIMILARITY, Gauge.RIGID, Gauge.YAW_TRANSLATION]


@pytest.fixture(scope='module', params=GAUGES)
def revisions(request):
    """Six sub-maps, and second revisions of them: other noise, some other landmarks."""
    config = FleetConfig(**SETTINGS, sensing=Sensing(gauge=request.param))
    first = simulate_fleet(config, 3).submaps(catalogue=False)
    again = simulate_fleet(config, 3)
    rng = np.random.default_rng(0)
    newer = []
    for submap in again.submaps(catalogue=False):
        size = np.ptp(submap.points, axis=0).max()
        step = 1e-4 * size * rng.normal(size=3 * submap.compressed_count)
        # c is the residual at q°: in step with it, the map says the same of other points.
        newer.append(
            replace(
                submap,
                revision=2,
                points=submap.points + step.reshape(-1, 3),
                c=submap.c + 0.3 * rng.normal(size=submap.rank),
            )
        )
    return first, newer


def assert_same(fusion, other):
    """Same up to what the solver leaves of its last step: 1e-4 of the standard deviations."""
    found, expected = fusion.components[0].landmarks, other.components[0].landmarks
    np.testing.assert_array_equal(found.ids, expected.ids)
    S = align(expected.points_global, found.points_global, gauge=fusion.components[0].gauge)
    moved = S.S_target_source.apply(found.points_global)
    spread = np.linalg.norm(expected.std, axis=1).max()
    assert np.abs(moved - expected.points_global).max() < 1e-4 * spread
    np.testing.assert_allclose(found.std, expected.std, rtol=1e-3, atol=1e-4 * spread)
    assert fusion.verdict.a_tilde == pytest.approx(other.verdict.a_tilde, rel=1e-9)
    assert fusion.verdict.accepted == other.verdict.accepted
    assert fusion.verdict.dof == other.verdict.dof


def histories(first, newer):
    """Sets of sub-maps one after the other: replaced, new, gone, all other, and back."""
    yield [newer[2], *first[:2], *first[3:]]
    yield first[:5]
    yield [*first[:5], newer[5]]
    yield newer[1:]
    yield first


def test_a_warm_fusion_is_the_cold_one(revisions):
    warm = Warm()
    fuse(revisions[0], SHARP, warm=warm)
    for submaps in histories(*revisions):
        assert_same(fuse(submaps, SHARP, warm=warm), fuse(submaps, SHARP))


def test_the_cold_fusion_has_no_history(revisions):
    """The same set gives the same bits, whatever was fused before without memory."""
    first, newer = revisions
    fuse(newer)
    one, two = fuse(first), fuse(first)
    np.testing.assert_array_equal(one.global_map.points, two.global_map.points)
    np.testing.assert_array_equal(one.global_map.packed_r, two.global_map.packed_r)


def test_sub_maps_that_did_not_change_need_no_new_factor(revisions, monkeypatch):
    first, _ = revisions
    made = []
    plain = joint.factorise

    def counted(*args, **kwargs):
        made.append(1)
        return plain(*args, **kwargs)

    monkeypatch.setattr(joint, 'factorise', counted)
    warm = Warm()
    fuse(first, warm=warm)
    assert made
    made.clear()
    fuse(first, warm=warm)
    assert not made


def test_one_revision_takes_few_steps(revisions):
    """With the factor made at the last optimum, and not where the last merge started."""
    first, newer = revisions
    warm = Warm()
    cold = fuse(first, warm=warm).components[0]
    replaced = fuse([newer[2], *first[:2], *first[3:]], warm=warm).components[0]
    assert replaced.iterations <= min(5, cold.iterations)


def test_links_of_pairs_that_did_not_change_are_kept(revisions):
    first, newer = revisions
    config, warm = FusionConfig(), Warm()
    before = find_links(first, associate_by_id(first), config, warm)
    submaps = [newer[0], *first[1:]]
    warm.turn()
    after = find_links(submaps, associate_by_id(submaps), config, warm)
    plain = find_links(submaps, associate_by_id(submaps), config)
    kept = {id(link.S_a_b) for link in before}
    for link, cold in zip(after, plain, strict=True):
        assert (link.a, link.b, link.shared) == (cold.a, cold.b, cold.shared)
        np.testing.assert_array_equal(link.contradicting, cold.contradicting)
        np.testing.assert_allclose(link.S_a_b.log(), cold.S_a_b.log(), atol=1e-12)
        assert (id(link.S_a_b) in kept) == (link.a > 0)


def test_an_engine_forgets_what_is_gone(revisions):
    first, _ = revisions
    engine = FusionEngine()
    for submap in first:
        engine.add(submap)
    engine.fuse()
    engine.reset()
    engine.fuse()
    engine.fuse()
    assert engine.memory.last_merge([submap.map_id for submap in first]) is None


@pytest.mark.parametrize('k', [2, 5])
def test_a_changed_factor_leads_to_the_cold_fusion(revisions, monkeypatch, k):
    """In a fleet this small it does not pay by itself."""
    first, newer = revisions
    found, plain = [], resuming.change

    def noted(*args):
        found.append(plain(*args))
        return found[-1]

    monkeypatch.setattr(resuming, 'change', noted)
    # A better camera: R itself has to be another one.
    better = replace(newer[k], packed_r=1.2 * newer[k].packed_r, c=1.2 * newer[k].c)
    maps = [*first[:k], better, *first[k + 1 :]]
    cold = fuse(maps, SHARP)
    for price, is_changed in ((resuming.HIGHEST_PRICE, False), (np.inf, True)):
        monkeypatch.setattr(resuming, 'HIGHEST_PRICE', price)
        warm = Warm()
        fuse(first, SHARP, warm=warm)
        assert_same(fuse(maps, SHARP, warm=warm), cold)
        assert bool(found and found[0]) == is_changed
