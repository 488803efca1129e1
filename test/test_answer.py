# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot's side of a request: exactly what was asked for, within the bytes, never backwards."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import random_bundle
from submaps import real_model

from mapmerge_ros.bundle import Bundle, MapName, announce, answer, compress
from mapmerge_ros.errors import InvalidValue
from mapmerge_ros.io import (
    BagError,
    InvalidMessage,
    NamedBundle,
    create,
    decode_request,
    encode_bundle,
    encode_request,
    encode_submap,
    load_bundles,
    record,
)
from mapmerge_ros.io.codec import serialise
from mapmerge_ros.io.request_messages import request_to_message
from mapmerge_ros.io.typestore import BUNDLE
from mapmerge_ros.nodes.own_map import OwnMap, Response, work
from mapmerge_ros.submap import Request, catalogue_bytes, information_bytes

NAME = MapName('drone/0001', 'drone', 7, 5, 'drone/map', 'fleet')
BUNDLE_30: Bundle = random_bundle(0, points=30)
NAMED = NamedBundle(NAME, BUNDLE_30, (0,) * len(BUNDLE_30.keyframe_ids))


def request(ids: Any, **changes: Any) -> Request:
    values: dict[str, Any] = {
        'map_id': NAME.map_id,
        'robot_id': NAME.robot_id,
        'revision': 7,
        'landmark_ids': np.asarray(ids, np.uint64),
    }
    return Request(**{**values, **changes})


def test_an_announcement_has_everything_but_information() -> None:
    submap = announce(BUNDLE_30, NAME)
    assert submap.compressed_count == 0
    assert set(submap.landmark_ids) == set(BUNDLE_30.point_ids)
    full = compress(BUNDLE_30, NAME, BUNDLE_30.point_ids)
    assert submap.covariances is not None
    assert full.covariances is not None
    rows = np.argsort(submap.landmark_ids), np.argsort(full.landmark_ids)
    ratio = submap.covariances[rows[0]] / full.covariances[rows[1]]
    assert 0.5 < np.median(ratio) < 2.0, 'the noise is known before anything is compressed'


def test_the_answer_is_what_the_bundle_says_about_those_landmarks() -> None:
    ids = BUNDLE_30.point_ids[[3, 17, 5, 9, 11]]
    found = answer(BUNDLE_30, announce(BUNDLE_30, NAME), request(ids), 8)
    assert found.submap is not None
    assert encode_submap(found.submap) == encode_submap(
        compress(BUNDLE_30, replace(NAME, revision=8), ids)
    )
    assert (found.reason, len(found.unknown), found.dropped) == ('', 0, 0)


def test_unknown_landmarks_are_left_out() -> None:
    ids = [*BUNDLE_30.point_ids[:5], 999, 998]
    found = answer(BUNDLE_30, announce(BUNDLE_30, NAME), request(ids), 8)
    assert found.submap is not None
    np.testing.assert_array_equal(found.submap.compressed_ids, ids[:5])
    assert set(found.unknown) == {999, 998}


def test_landmarks_are_dropped_from_the_end_to_keep_the_bytes() -> None:
    announced = announce(BUNDLE_30, NAME)
    limit = catalogue_bytes(announced) + information_bytes(12) + 10
    found = answer(BUNDLE_30, announced, request(BUNDLE_30.point_ids, max_bytes=limit), 8)
    assert found.submap is not None
    assert found.dropped == 18
    np.testing.assert_array_equal(found.submap.compressed_ids, BUNDLE_30.point_ids[:12])
    assert len(encode_submap(found.submap)) <= limit


@pytest.mark.parametrize('ids', [[999, 998, 997], BUNDLE_30.point_ids[:2]])
def test_too_few_landmarks_are_no_answer(ids: Any) -> None:
    found = answer(BUNDLE_30, announce(BUNDLE_30, NAME), request(ids), 8)
    assert found.submap is None
    assert 'too few' in found.reason


def test_a_request_is_answered_once_and_repeated_as_it_was() -> None:
    own = OwnMap(NAMED, 100)
    asked = request(BUNDLE_30.point_ids[:10], revision=100)
    assert own.respond(asked) is Response.COMPRESS
    assert own.finish(work(own.job(asked)))
    raw = own.raw
    assert own.respond(asked) is Response.REPEAT
    assert own.raw is raw
    other = request(BUNDLE_30.point_ids[5:15], revision=101)
    assert own.respond(other) is Response.COMPRESS
    assert own.finish(work(own.job(other)))
    assert own.respond(replace(other, revision=102)) is Response.REPEAT


def test_requests_to_another_life_of_the_robot() -> None:
    own = OwnMap(NAMED, 100)
    asked = request(BUNDLE_30.point_ids[:10])
    assert own.respond(replace(asked, revision=99)) is Response.OUTDATED
    assert own.respond(replace(asked, revision=5000)) is Response.REANNOUNCE
    job = own.job(replace(asked, revision=100))
    own.reannounce(5000)
    revision = own.announced.revision
    assert revision > 5001, 'the request may have been answered'
    assert own.announced.sources[0].revision == revision
    assert not own.finish(work(job)), 'it was about the old announcement'
    assert own.respond(replace(asked, revision=5000)) is Response.OUTDATED
    assert own.respond(replace(asked, revision=revision)) is Response.COMPRESS


def test_what_cannot_be_done_leaves_the_last_revision() -> None:
    own = OwnMap(NAMED, 100)
    asked = request(BUNDLE_30.point_ids[:10], revision=100)
    own.finish(work(own.job(asked)))
    raw = own.raw
    assert not own.finish(work(own.job(request([999], revision=101))))
    assert own.raw is raw


def test_a_request_comes_back_from_its_bytes() -> None:
    asked = request([3, 1, 2**64 - 1], max_bytes=12345, frame_id='drone/map')
    found = decode_request(encode_request(asked, 1_500_000_000))
    for name in ('map_id', 'robot_id', 'revision', 'max_bytes', 'frame_id'):
        assert getattr(found, name) == getattr(asked, name)
    np.testing.assert_array_equal(found.landmark_ids, asked.landmark_ids)


def test_a_request_that_breaks_its_contract_is_refused() -> None:
    message = request_to_message(request([1, 2]), 0, create)
    for name, value in (
        ('map_id', ''),
        ('map_id', 'a\nb'),
        ('landmark_ids', np.zeros(0, np.uint64)),
        ('landmark_ids', np.ones(2, np.uint64)),
    ):
        wrong = replace(message, **{name: value})
        with pytest.raises(InvalidMessage, match=name):
            decode_request(serialise(wrong))
    with pytest.raises(InvalidMessage, match='bytes are not'):
        decode_request(b'\0\1\0\0nonsense')


def test_bundles_of_a_recording(tmp_path: Path) -> None:
    later = replace(NAMED, name=replace(NAME, revision=8))
    other = replace(NAMED, name=MapName('rover/0001', 'rover'))
    path = tmp_path / 'bundles.mcap'
    with record(path) as recorder:
        for k, named in enumerate((later, NAMED, other)):
            recorder.write_bytes('/bundle', k, BUNDLE, encode_bundle(named))
    (found,) = load_bundles(path, 'drone')
    assert (found.name.map_id, found.name.revision) == ('drone/0001', 8)
    np.testing.assert_array_equal(found.bundle.point_ids, BUNDLE_30.point_ids)
    with pytest.raises(InvalidValue, match='drone, rover'):
        load_bundles(path)
    with pytest.raises(BagError, match='No such file'):
        load_bundles(tmp_path / 'missing.mcap')


def test_the_bundle_of_a_model() -> None:
    pytest.importorskip('pycolmap')
    folder = real_model('brighton_drone') / 'session_0'
    (found,) = load_bundles(folder, id_space='site')
    assert (found.name.map_id, found.name.robot_id) == ('session_0/0000', 'session_0')
    assert found.name.id_space == 'site'
    assert len(load_bundles(folder, 'dji')[0].bundle.point_ids) > 1000
