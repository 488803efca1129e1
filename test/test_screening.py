# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Which pairs of many sub-maps are worth matching: no true one is missed."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from associated import real_maps

from mapmerge_ros.association import AssociationConfig, Decision, match_pair, screen
from mapmerge_ros.geometry import Gauge
from mapmerge_ros.simulation import announcement, random_frame
from mapmerge_ros.submap import Descriptors, DescriptorType

CONFIG = AssociationConfig()


def ring(count, seed=0):
    """Each map shares 30 of 150 landmarks with the next one, and the last with the first."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 120, 3))
    looks = rng.integers(0, 256, (count, 120, 32), dtype=np.uint8)
    maps = []
    for k in range(count):
        after = (k + 1) % count
        rows = np.concatenate([looks[k], looks[after, :30]])
        rows = rows ^ np.packbits(rng.random((150, 32, 8)) < 0.08, axis=-1)[..., 0]
        where = random_frame(rng, Gauge.SIMILARITY).apply(
            np.concatenate([points[k], points[after, :30]])
        )
        maps.append(announcement(f'map{k:02d}', where, rows))
    return maps, {tuple(sorted((k, (k + 1) % count))) for k in range(count)}


def test_few_maps_are_all_matched():
    maps, _ = ring(8)
    assert screen(maps, CONFIG) == tuple(combinations(range(8), 2))


def test_screening_keeps_every_true_pair_of_many_and_little_else():
    maps, true = ring(30)
    chosen = set(screen(maps, CONFIG))
    assert true <= chosen
    assert len(chosen) < 60


def test_the_order_of_maps_does_not_change_what_is_matched():
    maps, _ = ring(20, seed=1)
    order = np.random.default_rng(1).permutation(20)
    names = [{maps[i].map_id, maps[j].map_id} for i, j in screen(maps, CONFIG)]
    mixed = [maps[k] for k in order]
    again = [{mixed[i].map_id, mixed[j].map_id} for i, j in screen(mixed, CONFIG)]
    assert sorted(map(sorted, names)) == sorted(map(sorted, again))


def test_maps_of_nothing_alike_are_not_worth_matching():
    rng = np.random.default_rng(4)
    for count in (0, 1, 2, 14):
        maps = [
            announcement(f'{k:02d}', np.eye(3), rng.integers(0, 256, (3, 32), dtype=np.uint8))
            for k in range(count)
        ]
        assert screen(maps, replace(CONFIG, screen_above=0)) == ()


def test_a_place_that_all_of_a_large_fleet_see_is_no_reason_to_skip_it():
    rng = np.random.default_rng(5)
    points, rows = rng.normal(size=(20, 3)), rng.integers(0, 256, (20, 32), dtype=np.uint8)
    maps = [announcement(f'{k:02d}', points, rows) for k in range(80)]
    assert len(screen(maps, CONFIG)) == 80 * 79 // 2


def test_screening_survives_equal_missing_and_foreign_descriptors():
    maps, true = ring(14, seed=2)
    same = np.full((4000, 32), 9, np.uint8)
    rng = np.random.default_rng(3)
    points = rng.normal(size=(4000, 3))
    sift = rng.integers(0, 256, (4000, 128), dtype=np.uint8)
    odd = [
        announcement('equal0', points, same),
        announcement('equal1', points, same),
        announcement('zero', points, 0 * same),
        announcement('sift', points, sift, kind=DescriptorType.SIFT),
        replace(announcement('none', points, same), descriptors=Descriptors.none(4000)),
    ]
    chosen = set(screen(maps + odd, CONFIG))
    assert true <= chosen
    assert not {pair for pair in chosen if max(pair) >= 16}, 'nothing can be said of these'


def test_screening_loses_no_pair_of_euroc_that_can_be_joined():
    maps = real_maps('euroc_v101_maplab')
    chosen = set(screen(maps, replace(CONFIG, screen_above=0)))
    for i, j in set(combinations(range(8), 2)) - chosen:
        assert match_pair(maps[i], maps[j], CONFIG).decision is not Decision.JOINED
