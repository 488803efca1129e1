# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages: what goes out comes back, byte for byte; what is wrong is refused by name."""

from __future__ import annotations

import array
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from submaps import assert_same, random_bundle, random_submap, small_submap

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.io import (
    MAX_MESSAGE_BYTES,
    InvalidMessage,
    bundle_from_message,
    bundle_to_message,
    class_factory,
    create,
    decode_submap,
    encode_bundle,
    encode_submap,
    submap_from_message,
    submap_to_message,
)
from mapmerge_ros.io.codec import deserialise, serialise
from mapmerge_ros.io.typestore import (
    BUNDLE,
    MSGS_VERSION,
    SUBMAP,
    message_texts,
    schema_text,
    typestore,
)

SEEDS = range(25)


@pytest.mark.parametrize('seed', SEEDS)
def test_submap_survives(seed: int) -> None:
    submap = random_submap(np.random.default_rng(seed))
    assert_same(decode_submap(encode_submap(submap)), submap)


@pytest.mark.parametrize('seed', SEEDS)
def test_bytes_survive(seed: int) -> None:
    raw = encode_submap(random_submap(np.random.default_rng(seed)))
    assert encode_submap(decode_submap(raw)) == raw


def test_r_stays_float32_and_float64_is_rounded_once() -> None:
    rng = np.random.default_rng(1)
    submap = random_submap(rng, compressed_count=0, packed_r=np.zeros(0), c=np.zeros(0))
    rank = 12 - int(submap.gauge)
    r = rng.normal(size=rank * 12 - rank * (rank - 1) // 2)
    submap = replace(submap, compressed_count=4, packed_r=r, c=rng.normal(size=rank))
    decoded = decode_submap(encode_submap(submap))
    assert decoded.packed_r.dtype == np.float32
    np.testing.assert_array_equal(decoded.packed_r, r.astype(np.float32))
    np.testing.assert_array_equal(decoded.c, submap.c.astype(np.float32))


def test_zero_c_is_sent_empty() -> None:
    submap = random_submap(np.random.default_rng(2))
    message = submap_to_message(replace(submap, c=-0.0 * submap.c), create)
    assert len(message.c) == 0
    np.testing.assert_array_equal(submap_from_message(message).c, np.zeros(submap.rank))


def test_big_endian_is_the_same_map() -> None:
    submap = random_submap(np.random.default_rng(3))
    message = submap_to_message(submap, create)
    raw = typestore().serialize_cdr(message, SUBMAP, little_endian=False)
    assert_same(decode_submap(raw), submap)


def test_every_text_is_registered_and_embedded_with_its_comments() -> None:
    names = message_texts()
    assert {'mapmerge_msgs/msg/SubMap', 'mapmerge_msgs/msg/Bundle'} <= set(names)
    assert set(names) <= set(typestore().types)
    text = schema_text(SUBMAP)
    assert text.startswith('# A compressed sub-map')
    assert re.findall('^MSG: (.*)$', text, re.M) == [
        'std_msgs/Header',
        'builtin_interfaces/Time',
        'mapmerge_msgs/MapSource',
    ]


def test_version_is_that_of_the_package() -> None:
    manifest = Path(__file__).parents[1] / 'msg_schemas' / 'package.xml'
    assert f'<version>{MSGS_VERSION}</version>' in manifest.read_text()


class Built:
    """A class as ROS builds it: keyword arguments, numbers in `array.array` only."""

    def __init__(self, **values: Any) -> None:
        for name, value in values.items():
            assert not isinstance(value, np.ndarray), name
            setattr(self, name, value)


def test_classes_built_by_ros_share_the_codec() -> None:
    rng = np.random.default_rng(4)
    make = class_factory(lambda name: Built)
    submap = random_submap(rng, revision=5)
    message = submap_to_message(submap, make)
    assert isinstance(message.r, array.array)
    assert (message.r.typecode, message.landmark_ids.typecode) == ('f', 'Q')
    assert_same(submap_from_message(message), submap)
    named = random_bundle(rng)
    assert_same(bundle_from_message(bundle_to_message(named, make)).bundle, named.bundle)


def test_messages_of_a_real_build() -> None:
    """Against mapmerge_msgs itself, where it is installed."""
    messages = pytest.importorskip('mapmerge_msgs.msg', reason='mapmerge_msgs is not built here')
    std, time = pytest.importorskip('std_msgs.msg'), pytest.importorskip('builtin_interfaces.msg')
    packages = {'mapmerge_msgs': messages, 'std_msgs': std, 'builtin_interfaces': time}

    def find(name: str) -> type[Any]:
        found: type[Any] = getattr(packages[name.split('/')[0]], name.split('/')[-1])
        return found

    rng = np.random.default_rng(5)
    submap, named = random_submap(rng), random_bundle(rng)
    built = submap_to_message(submap, class_factory(find))
    assert built.get_fields_and_field_types().keys() == {
        name for name, _ in typestore().fielddefs[SUBMAP][1]
    }
    assert_same(submap_from_message(built), submap)
    built_bundle = bundle_to_message(named, class_factory(find))
    assert_same(bundle_from_message(built_bundle).bundle, named.bundle)


Spoil = Callable[[Any], None]


def setter(name: str, value: Any) -> Spoil:
    return lambda message: setattr(message, name, value)


def resized(name: str, count: int) -> Spoil:
    return lambda message: setattr(message, name, np.resize(getattr(message, name), count))


def not_finite(name: str) -> Spoil:
    def spoil(message: Any) -> None:
        values = getattr(message, name).copy()
        values[1] = np.nan
        setattr(message, name, values)

    return spoil


BAD_SUBMAPS: dict[str, tuple[Spoil, str]] = {
    'points odd': (resized('points', 14), 'points: expected 3 x 5 values, got 14'),
    'points short': (resized('points', 12), 'points: expected 3 x 5 values, got 12'),
    'points nan': (not_finite('points'), 'points: value 1 is not finite'),
    'covariances': (resized('covariances', 29), 'covariances: expected 6 x 5'),
    'covariances nan': (not_finite('covariances'), 'covariances: value 1 is not finite'),
    'r short': (resized('r', 5), 'r: expected'),
    'r nan': (not_finite('r'), 'r: value 1 is not finite'),
    'c short': (resized('c', 2), 'c: expected'),
    'c nan': (not_finite('c'), 'c: value 1 is not finite'),
    'descriptors': (resized('descriptors', 159), 'descriptors: expected 5 rows of 32 bytes'),
    'size': (setter('descriptor_size', 31), 'descriptors: expected 5 rows of 31 bytes'),
    'kind': (setter('descriptor_type', 3), 'descriptor_type: 3 is none of'),
    'none': (setter('descriptor_type', 0), 'descriptor_type: NONE, but'),
    'sift': (setter('descriptor_type', 2), 'descriptor_size: SIFT has 128 bytes'),
    'gauge': (setter('gauge', 5), 'gauge: 5 is none of'),
    'other gauge': (setter('gauge', 4), 'r: expected'),
    'count': (setter('compressed_count', 6), 'compressed_count: 6 of 5'),
    'large count': (setter('compressed_count', 2**32 - 1), 'compressed_count: 4294967295 of 5'),
    'few': (setter('compressed_count', 2), 'compressed_count: 2 landmarks cannot carry'),
    'ids': (setter('landmark_ids', np.ones(5, np.uint64)), 'landmark_ids: id 1 appears twice'),
    'no ids': (setter('landmark_ids', np.zeros(0, np.uint64)), 'points: expected 3 x 0'),
    'sources': (setter('sources', []), 'sources: empty'),
    'a': (setter('a', -1.0), 'a: -1.0'),
    'a nan': (setter('a', np.nan), 'a: nan'),
    'sigma': (setter('sigma', np.inf), 'sigma: inf'),
    'dof': (setter('dof', 0), 'dof: zero'),
    'redundancy': (setter('dof', 10**6), 'dof: 1000000 parameters'),
    'residuals': (setter('residual_count', 0), 'residual_count: zero'),
    'control': (setter('robot_id', 'a\x1b[2J'), 'robot_id: a control character'),
    'frame': (lambda message: setattr(message.header, 'frame_id', ''), 'frame_id: empty'),
    'stamp': (
        lambda message: setattr(message.header.stamp, 'nanosec', 10**9),
        'header.stamp: 1000000000 nanoseconds',
    ),
}


@pytest.mark.parametrize('case', BAD_SUBMAPS)
def test_bad_submap_is_refused_by_field(case: str) -> None:
    spoil, reason = BAD_SUBMAPS[case]
    message = submap_to_message(small_submap(), create)
    spoil(message)
    with pytest.raises(InvalidMessage) as caught:
        submap_from_message(message)
    assert str(caught.value).startswith(f"sub-map 'drone1/0001': {reason}")
    assert '\n' not in str(caught.value)


def test_too_large_a_message_is_refused_before_it_is_decoded() -> None:
    with pytest.raises(InvalidMessage, match='200 MiB, the limit is 128 MiB'):
        decode_submap(memoryview(bytearray(200 * 2**20)))
    message = submap_to_message(small_submap(), create)
    message.r = np.broadcast_to(np.float32(1.0), MAX_MESSAGE_BYTES // 4)  # no memory is taken
    with pytest.raises(InvalidMessage, match=r'drone1/0001.*the limit is 128 MiB'):
        submap_from_message(message)


@pytest.mark.parametrize('seed', range(5))
def test_damaged_bytes_are_refused_and_nothing_else_happens(seed: int) -> None:
    rng = np.random.default_rng(seed)
    raw = encode_submap(random_submap(rng))
    for _ in range(200):
        damaged = bytearray(raw[: rng.integers(len(raw) + 1)])
        for place in rng.integers(0, max(len(damaged), 1), rng.integers(4)):
            damaged[place : place + 1] = bytes([rng.integers(256)])
        try:
            decode_submap(bytes(damaged))
        except InvalidMessage as err:
            assert '\n' not in str(err)


def test_what_no_field_can_hold_is_not_sent() -> None:
    submap = small_submap()
    for change, reason in (
        ({'stamp_ns': 2**31 * 10**9}, 'stamp_ns'),
        ({'revision': 2**32}, 'revision'),
    ):
        with pytest.raises(InvalidMessage, match=reason):
            encode_submap(replace(submap, **change))


def test_bytes_of_another_type_are_no_submap() -> None:
    raw = encode_bundle(random_bundle(np.random.default_rng(9)))
    with pytest.raises(MapMergeError):
        decode_submap(raw)
    header = create(
        'std_msgs/msg/Header',
        stamp=create('builtin_interfaces/msg/Time', sec=1, nanosec=2),
        frame_id='map',
    )
    with pytest.raises(InvalidMessage, match='bytes are not a mapmerge_msgs/msg/Bundle'):
        deserialise(serialise(header), BUNDLE)


def test_values_are_not_views_of_the_message() -> None:
    message = submap_to_message(small_submap(), create)
    message.r = message.r.copy()
    submap = submap_from_message(message)
    message.r[:] = 7.0
    assert (submap.packed_r == 1.0).all()
    assert not submap.packed_r.flags.writeable
