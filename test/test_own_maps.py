# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A SLAM that keeps sending bundles: what was asked of the last one is answered from the next."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scenes import random_bundle, without_points

from mapmerge_ros.bundle import Bundle, MapName
from mapmerge_ros.io import NamedBundle, decode_submap, encode_bundle
from mapmerge_ros.nodes.own_map import OwnMap, Response
from mapmerge_ros.nodes.own_maps import OwnMaps
from mapmerge_ros.submap import Request

MAP = 'drone/0001'
FIRST = 100
BUNDLE: Bundle = random_bundle(0, points=30)


def named(revision: int, stamp_ns: int = 5, first_id: int = 0) -> NamedBundle:
    bundle = replace(BUNDLE, point_ids=BUNDLE.point_ids + np.uint64(first_id))
    name = MapName(MAP, 'drone', revision, stamp_ns, 'drone/map', 'fleet')
    return NamedBundle(name, bundle, (0,) * len(bundle.keyframe_ids))


def request(ids: Any, revision: int = FIRST) -> Request:
    return Request(MAP, 'drone', revision, np.asarray(ids, np.uint64))


def asked_maps(ids: Any) -> OwnMaps:
    """One map, of which these landmarks were asked and sent."""
    maps = OwnMaps('drone', FIRST)
    maps.take(maps.prepare(named(1)))
    assert maps[MAP].finish(maps.answer(request(ids)))
    return maps


def take(maps: OwnMaps, bundle: NamedBundle) -> OwnMap:
    return maps[maps.take(maps.prepare(bundle))]


def test_a_new_bundle_is_compressed_to_what_was_asked_before() -> None:
    ids = BUNDLE.point_ids[[3, 17, 5, 9, 11, 20]]
    maps = asked_maps(ids)
    before = maps[MAP].newest
    for revision in (2, 3, 4):
        own = take(maps, named(revision))
        submap = decode_submap(own.raw)
        np.testing.assert_array_equal(submap.compressed_ids, ids)
        assert set(submap.landmark_ids) == set(BUNDLE.point_ids), 'the others are its catalogue'
        assert submap.revision == own.newest > before
        assert submap.sources[0].revision == submap.revision
        assert own.respond(request(ids, own.newest)) is Response.REPEAT
        before = own.newest


def test_revisions_rise_with_those_of_the_slam() -> None:
    maps = asked_maps(BUNDLE.point_ids[:6])
    seen = [maps[MAP].newest]
    for revision in (2, 5000, 5001, 5002):
        own = take(maps, named(revision))
        assert decode_submap(own.raw).compressed_count == 6
        assert own.newest >= revision
        seen.append(own.newest)
    assert seen == sorted(set(seen))


def test_ids_that_are_gone_are_left_out_and_come_back() -> None:
    ids = BUNDLE.point_ids[:6]
    maps = asked_maps(ids)
    fewer = take(maps, replace(named(2), bundle=without_points(BUNDLE, ids[:2])))
    np.testing.assert_array_equal(decode_submap(fewer.raw).compressed_ids, ids[2:])
    again = take(maps, named(3))
    np.testing.assert_array_equal(decode_submap(again.raw).compressed_ids, ids)


def test_too_few_that_are_left_make_an_announcement() -> None:
    maps = asked_maps(BUNDLE.point_ids[:6])
    own = take(maps, named(2, first_id=1000))
    submap = decode_submap(own.raw)
    assert (submap.compressed_count, own.asked) == (0, None)
    assert 'too few' in own.bare_reason
    assert own.newest > FIRST + 1
    assert decode_submap(take(maps, named(3)).raw).compressed_count == 6, 'they are back'


def test_nobody_has_asked_yet() -> None:
    maps = OwnMaps('drone', FIRST)
    for revision in (1, 2, 3):
        assert decode_submap(take(maps, named(revision)).raw).compressed_count == 0


def test_a_request_about_an_earlier_bundle_is_answered_from_the_newest() -> None:
    """It was on its way, or the fusion side was merging, while the SLAM went on."""
    maps = OwnMaps('drone', FIRST)
    maps.take(maps.prepare(named(1)))
    for revision in (2, 3):
        take(maps, named(revision))
    own, late = maps[MAP], request(BUNDLE.point_ids[:6], FIRST)
    assert own.respond(late) is Response.COMPRESS
    assert own.finish(maps.answer(late))
    assert decode_submap(own.raw).revision > FIRST + 2


def test_a_slam_that_was_restarted_is_asked_anew() -> None:
    """It counts from the beginning and has a later stamp; its ids may be other points."""
    maps = asked_maps(BUNDLE.point_ids[:6])
    own = take(maps, named(1, stamp_ns=6))
    assert decode_submap(own.raw).compressed_count == 0
    assert own.newest > FIRST + 1
    assert own.respond(request(BUNDLE.point_ids[:6], FIRST + 1)) is Response.OUTDATED


def test_a_robot_that_learns_of_an_earlier_life_meanwhile_announces() -> None:
    maps = asked_maps(BUNDLE.point_ids[:6])
    prepared = maps.prepare(named(2))
    maps[MAP].reannounce(9000)
    own = maps[maps.take(prepared)]
    submap = decode_submap(own.raw)
    assert submap.revision == own.newest > 9000
    assert (submap.compressed_count, own.compressed_count, own.asked) == (0, 0, None)


def test_only_what_is_newer_is_wanted() -> None:
    maps = OwnMaps('drone', FIRST)
    maps.take(maps.prepare(named(2)))
    assert not maps.wants(named(2).name)
    assert not maps.wants(named(1).name)
    assert maps.wants(named(3).name)
    assert maps.wants(named(1, stamp_ns=6).name)
    assert not maps.wants(replace(named(3).name, robot_id='rover'))
    assert maps.decode(encode_bundle(named(1))) is None
    assert maps.decode(encode_bundle(named(3))) is not None
