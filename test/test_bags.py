# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings: readable by everyone, read from everyone, and never half written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from recordings import START_NS, Entry, entries, rosbag2_folder
from rosbags.interfaces import Qos, QosDurability
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin
from submaps import assert_same, random_bundle, random_submap

from mapmerge_ros.io import (
    BagError,
    Recorded,
    Recording,
    create,
    encode_bundle,
    encode_submap,
    read_submaps,
    record,
    write_submaps,
)
from mapmerge_ros.io.typestore import BUNDLE, SUBMAP, schema_text, typestore


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / 'bag.mcap'
    write_submaps(path, entries(0))
    return path


def assert_recorded(found: list[Recorded], expected: list[Entry]) -> None:
    assert [(item.topic, item.log_time_ns) for item in found] == [row[:2] for row in expected]
    for item, (_, _, submap) in zip(found, expected, strict=True):
        assert item.submap is not None
        assert item.size_bytes == len(encode_submap(submap))
        assert_same(item.submap, submap)


def test_what_is_written_is_read(bag: Path) -> None:
    assert_recorded(list(read_submaps(bag)), entries(0))
    with Recording(bag) as recording:
        assert recording.total == 8
        assert [len(list(recording)) for _ in range(2)] == [8, 8]


def test_messages_come_in_time_order_whatever_the_order_of_writing(tmp_path: Path) -> None:
    rows = entries(1, 30)
    shuffled = [rows[i] for i in np.random.default_rng(1).permutation(30)]
    write_submaps(tmp_path / 'a.mcap', shuffled[:17])
    write_submaps(tmp_path / 'b.mcap', shuffled[17:])
    paths: list[Path | str] = [tmp_path / 'b.mcap', str(tmp_path / 'a.mcap')]
    assert_recorded(list(read_submaps(paths)), rows)


@pytest.mark.parametrize('storage', list(StoragePlugin))
def test_rosbag2_folders_give_the_same(tmp_path: Path, storage: StoragePlugin) -> None:
    folder = rosbag2_folder(tmp_path / 'bag', entries(2), storage)
    assert_recorded(list(read_submaps(folder)), entries(2))


@pytest.mark.parametrize('mode', [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_sqlite3_gives_the_same(tmp_path: Path, mode: CompressionMode) -> None:
    folder = rosbag2_folder(
        tmp_path / 'bag',
        entries(3),
        StoragePlugin.SQLITE3,
        mode=mode,
        fmt=CompressionFormat.ZSTD,
    )
    assert_recorded(list(read_submaps(folder)), entries(3))


def test_single_files_of_a_folder_are_read_too(tmp_path: Path) -> None:
    folder = rosbag2_folder(tmp_path / 'bag', entries(4), StoragePlugin.SQLITE3)
    assert_recorded(list(read_submaps(folder / 'bag.db3')), entries(4))


def read_independently(path: Path) -> list[tuple[str, int, Any]]:
    """Topic, time and message, by a decoder that shares no code with ours."""
    with path.open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [
            (channel.topic, message.log_time, decoded)
            for _, channel, message, decoded in reader.iter_decoded_messages()
        ]


def test_an_independent_reader_finds_every_field(bag: Path) -> None:
    def same(ours: Any, theirs: Any) -> None:
        for name, _ in typestore().fielddefs[ours.__msgtype__][1]:
            one, other = getattr(ours, name), getattr(theirs, name)
            if hasattr(one, '__msgtype__'):
                same(one, other)
            elif isinstance(one, np.ndarray):
                np.testing.assert_array_equal(one, np.array(list(other), one.dtype))
            elif isinstance(one, list):
                assert len(one) == len(other)
                for inner in zip(one, other, strict=True):
                    same(*inner)
            else:
                assert one == other, name

    found = read_independently(bag)
    for (*where, submap), (*place, theirs) in zip(entries(0), found, strict=True):
        assert where == place
        same(typestore().deserialize_cdr(encode_submap(submap), SUBMAP), theirs)


def test_the_file_is_a_ros2_recording(bag: Path) -> None:
    with bag.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == 'ros2'
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 8
        (schema,) = summary.schemas.values()
        assert (schema.name, schema.encoding) == (SUBMAP, 'ros2msg')
        assert schema.data.decode() == schema_text(SUBMAP)
        for channel in summary.channels.values():
            assert channel.message_encoding == 'cdr'
            assert channel.metadata['topic_type_hash'] == typestore().hash_rihs01(SUBMAP)
    with Reader(bag) as bag_reader:
        for connection in bag_reader.connections:
            (qos,) = connection.ext.offered_qos_profiles  # type: ignore[union-attr]
            assert isinstance(qos, Qos)
            assert qos.durability is QosDurability.TRANSIENT_LOCAL


def test_other_messages_go_into_the_same_file(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    submap = random_submap(rng)
    time = create('builtin_interfaces/msg/Time', sec=1, nanosec=2)
    header = create('std_msgs/msg/Header', stamp=time, frame_id='global')
    with record(tmp_path / 'mixed.mcap') as recorder:
        changes = create('mapmerge_msgs/msg/ChangeArray', header=header, changes=[])
        recorder.write('/fusion/changes', 1, changes)
        recorder.write_submap('/fusion/global_map', 2, submap)
        recorder.write_bytes('/drone1/bundle', 3, BUNDLE, encode_bundle(random_bundle(rng)))
        recorder.declare('/fusion/alignments', 'mapmerge_msgs/msg/AlignmentArray')
    assert_recorded(
        list(read_submaps(tmp_path / 'mixed.mcap')), [('/fusion/global_map', 2, submap)]
    )
    found = read_independently(tmp_path / 'mixed.mcap')
    assert [topic for topic, _, _ in found] == [
        '/fusion/changes',
        '/fusion/global_map',
        '/drone1/bundle',
    ]
    assert found[0][2].header.frame_id == 'global'


def test_the_same_submaps_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ('a.mcap', 'b.mcap'):
        write_submaps(tmp_path / name, entries(6))
    assert (tmp_path / 'a.mcap').read_bytes() == (tmp_path / 'b.mcap').read_bytes()


def test_a_bad_message_is_a_refusal_and_the_others_come(tmp_path: Path) -> None:
    rows = entries(7, 3)
    message = typestore().deserialize_cdr(encode_submap(rows[0][2]), SUBMAP)
    message.gauge = 5  # type: ignore[attr-defined]
    with record(tmp_path / 'bag.mcap') as recorder:
        recorder.write_submap(*rows[0])
        recorder.write('/drone1/submap', START_NS + 1, message)
        recorder.write_bytes('/drone1/submap', START_NS + 2, SUBMAP, b'\0\1\0\0not a sub-map')
        recorder.write_bytes('/drone1/submap', START_NS + 3, SUBMAP, b'')
        recorder.write_submap(*rows[1])
    found = list(read_submaps(tmp_path / 'bag.mcap'))
    assert [item.submap is None for item in found] == [False, True, True, True, False]
    assert f"sub-map '{rows[0][2].map_id}': gauge: 5" in found[1].refusal
    assert 'bytes are not a mapmerge_msgs/msg/SubMap' in found[2].refusal
    assert all('\n' not in item.refusal for item in found)


def write_with_schema(path: Path, text: str, encoding: str = 'ros2msg') -> Path:
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start(profile='ros2')
        schema = writer.register_schema(SUBMAP, encoding, text.encode())
        channel = writer.register_channel('/submap', 'cdr', schema)
        raw = encode_submap(entries(8, 1)[0][2])
        writer.add_message(channel, START_NS, raw, START_NS)
        writer.finish()  # type: ignore[no-untyped-call]
    return path


@pytest.mark.parametrize(
    ('old', 'new', 'reason'),
    [
        ('float64 a ', 'float32 a ', 'other type: a'),
        ('float64 sigma ', 'float64 noise ', 'missing: sigma, unknown: noise'),
        ('uint64 dof', '# uint64 dof', 'missing: dof'),
        ('uint32 revision  # revision of that', 'uint64 revision  #', 'MapSource: other type'),
        ('string robot_id ', 'strong robot_id ', 'cannot be parsed|missing|other type'),
    ],
)
def test_another_definition_is_an_error(tmp_path: Path, old: str, new: str, reason: str) -> None:
    text = schema_text(SUBMAP)
    assert old in text
    path = write_with_schema(tmp_path / 'old.mcap', text.replace(old, new, 1))
    with pytest.raises(BagError, match=reason) as caught:
        list(read_submaps(path))
    assert str(caught.value).startswith(f'{path}: topic /submap has another definition')
    assert 're-record with mapmerge_msgs 0.1.0' in str(caught.value)


def test_comments_and_generated_texts_do_not_matter(tmp_path: Path) -> None:
    text = typestore().generate_msgdef(SUBMAP, ros_version=2)[0]
    assert len(list(read_submaps(write_with_schema(tmp_path / 'bag.mcap', text)))) == 1
