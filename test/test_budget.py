# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks within a budget: bytes are kept and used, and what others have comes first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import random_bundle
from submaps import random_submap

from mapmerge_ros.bundle import Bundle, MapName, announce, compress
from mapmerge_ros.bundle.selection import best_tracks, ranked_tracks
from mapmerge_ros.cli.choosing import Budget, choose
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.fusion import FusionConfig, fuse
from mapmerge_ros.io import encode_submap
from mapmerge_ros.submap import SubMap, catalogue_bytes, information_bytes, most_landmarks


def pair(points: int = 120) -> tuple[list[Bundle], list[MapName]]:
    """Two bundles of one place with every other point in common, and how they are called."""
    place, bundles = random_bundle(0, points=points), []
    for k in range(2):
        noise = np.random.default_rng(k).normal(size=place.observations_px.shape)
        bundle = replace(place, observations_px=place.observations_px + 0.1 * noise)
        own = np.arange(points) % 2 == 1
        ids = bundle.point_ids + np.where(own, 1000 * (k + 1), 0).astype(np.uint64)
        bundles.append(replace(bundle, point_ids=ids))
    names = [MapName(f'd{k}/1', f'd{k}', id_space='site') for k in range(2)]
    return bundles, names


@pytest.mark.parametrize('catalogue', [True, False])
@pytest.mark.parametrize('max_bytes', [20_000, 60_000, 150_000])
def test_bytes_are_kept_and_used(max_bytes: int, catalogue: bool) -> None:
    bundles, names = pair(300)
    budget = Budget(500, max_bytes, catalogue)
    for wanted in ('all', 90):
        for bundle, name, ids in zip(
            bundles, names, choose(bundles, names, wanted, budget), strict=True
        ):
            raw = encode_submap(compress(bundle, name, ids, catalogue=catalogue))
            assert len(raw) <= max_bytes
            if wanted == 'all':
                next_bytes = information_bytes(len(ids) + 1) - information_bytes(len(ids))
                assert len(raw) > max_bytes - next_bytes - 1500  # bounds are upper ones


def test_most_landmarks_is_the_largest_that_fits() -> None:
    submap = random_submap(np.random.default_rng(0))
    size = catalogue_bytes(submap)
    assert most_landmarks(submap, size) == 0
    for count in range(1, len(submap.landmark_ids)):
        assert most_landmarks(submap, size + information_bytes(count)) == count
        assert most_landmarks(submap, size + information_bytes(count) - 1) == count - 1
    assert most_landmarks(submap, 10**9) == len(submap.landmark_ids)


def test_a_budget_without_room_says_what_takes_it() -> None:
    bundles, names = pair()
    with pytest.raises(InvalidValue, match='the catalogue alone has'):
        choose(bundles, names, 'all', Budget(500, 3000))


def test_what_the_other_has_too_comes_first() -> None:
    bundles, names = pair()
    common = np.intersect1d(bundles[0].point_ids, bundles[1].point_ids)
    for count in (10, 40, 100):
        chosen = choose(bundles, names, count, Budget(500), good_only=False)
        for ids in chosen:
            assert len(ids) == count == len(np.unique(ids))
            assert np.isin(ids[: min(count, len(common))], common).all()
        both = np.intersect1d(*chosen)
        assert len(both) == min(count, len(common))


def test_one_model_takes_its_longest_tracks() -> None:
    (bundle, *_), (name, *_) = pair()
    (chosen,) = choose([bundle], [name], 25, Budget(500), good_only=False)
    assert set(chosen) == set(best_tracks(bundle, 25))
    ranked = ranked_tracks(bundle)
    lengths = np.bincount(bundle.observation_points)[bundle.rows_of(ranked)]
    assert (np.diff(lengths) <= 0).all()


def test_a_robot_keeps_its_own_limits() -> None:
    pytest.importorskip('rclpy', reason='parameters of nodes need ROS')
    from mapmerge_ros.geometry import Gauge
    from mapmerge_ros.nodes.compressor_parameters import CompressorSettings
    from mapmerge_ros.submap import Request

    request = Request('d/1', 'd', 1, np.arange(50, dtype=np.uint64), 90_000)
    free = CompressorSettings('', '', '', Gauge.SIMILARITY, 0.0, 0, 0, 0)
    assert free.limited(request).max_bytes == 90_000
    assert len(free.limited(request).landmark_ids) == 50
    bound = replace(free, max_landmarks=20, max_bytes=50_000)
    found = bound.limited(request)
    np.testing.assert_array_equal(found.landmark_ids, request.landmark_ids[:20])
    assert found.max_bytes == 50_000
    assert bound.limited(replace(request, max_bytes=0)).max_bytes == 50_000
    assert bound.limited(replace(request, max_bytes=10_000)).max_bytes == 10_000


def test_announcements_are_not_changed_by_a_budget() -> None:
    bundles, names = pair()
    announced = announce(bundles[0], names[0])
    assert len(encode_submap(announced)) <= catalogue_bytes(announced)


def merged_map(config: FusionConfig) -> SubMap:
    bundles, names = pair(200)
    common = np.intersect1d(bundles[0].point_ids, bundles[1].point_ids)
    submaps = [compress(*own, common[:60]) for own in zip(bundles, names, strict=True)]
    found = fuse(submaps, config).global_map
    assert found is not None
    return found


@pytest.mark.parametrize('max_bytes', [8_000, 30_000, 60_000])
def test_the_global_map_keeps_its_bytes(max_bytes: int) -> None:
    free = merged_map(FusionConfig())
    found = merged_map(FusionConfig(max_bytes=max_bytes))
    assert len(encode_submap(found)) <= max_bytes < len(encode_submap(free))
    assert 3 < found.compressed_count < free.compressed_count
    has_catalogue = len(found.landmark_ids) > found.compressed_count
    assert has_catalogue == (catalogue_bytes(free) <= max_bytes // 2 + 500)


def test_a_global_map_without_a_limit_is_as_it_was() -> None:
    free, wide = merged_map(FusionConfig()), merged_map(FusionConfig(max_bytes=10**7))
    assert encode_submap(free) == encode_submap(wide)
