# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings: readable by everyone, read from everyone, and never half written."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.interfaces import Qos, QosDurability
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from submaps import random_bundle, random_submap
from test_codec import assert_same

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.io import (
    BagError,
    OutputError,
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
from mapmerge_ros.submap import SubMap

START_NS = 1_700_000_000_000_000_000

Entry = tuple[str, int, SubMap]


def entries(seed: int, count: int = 8) -> list[Entry]:
    rng = np.random.default_rng(seed)
    return [
        (f'/drone{i % 3}/submap', START_NS + 10**9 * i, random_submap(rng)) for i in range(count)
    ]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    path = tmp_path / 'bag.mcap'
    write_submaps(path, entries(0))
    return path


def rosbag2_folder(path: Path, recorded: list[Entry], storage: StoragePlugin, **mode: Any) -> Path:
    bag_writer = BagWriter(path, version=9, storage_plugin=storage)
    if mode:
        bag_writer.set_compression(**mode)
    with bag_writer as writer:
        topics = {
            topic: writer.add_connection(topic, SUBMAP, typestore=typestore())
            for topic in sorted({topic for topic, _, _ in recorded})
        }
        for topic, log_time_ns, submap in recorded:
            writer.write(topics[topic], log_time_ns, encode_submap(submap))
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


def not_a_bag(path: Path) -> Path:
    path.write_text('Hello, this is not a recording at all.')
    return path


def empty(path: Path) -> Path:
    path.touch()
    return path


def without_submaps(path: Path) -> Path:
    raw = encode_bundle(random_bundle(np.random.default_rng(0)))
    with record(path) as recorder:
        recorder.write_bytes('/b', 1, BUNDLE, raw)
    return path


def folder(path: Path) -> Path:
    path.mkdir()
    return path


def broken_metadata(path: Path) -> Path:
    rosbag2_folder(path, entries(9), StoragePlugin.MCAP)
    (path / 'metadata.yaml').write_text('rosbag2_bagfile_information: [')
    return path


def lost_file(path: Path) -> Path:
    rosbag2_folder(path, entries(9), StoragePlugin.MCAP)
    next(path.glob('*.mcap')).unlink()
    return path


def broken_database(path: Path) -> Path:
    rosbag2_folder(path, entries(9, 40), StoragePlugin.SQLITE3)
    file = next(path.glob('*.db3'))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return path


def foreign_profile(path: Path) -> Path:
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start(profile='ros1')
        writer.finish()  # type: ignore[no-untyped-call]
    return path


BAD_BAGS: dict[str, tuple[str, Callable[[Path], Path], str]] = {
    'missing': ('x.mcap', lambda path: path, 'No such file or directory: check the path'),
    'text as mcap': ('x.mcap', not_a_bag, 'not a .mcap file'),
    'text as db3': ('x.db3', not_a_bag, 'not a .db3 file'),
    'other suffix': ('x.txt', not_a_bag, 'not a bag: give an .mcap file'),
    'empty': ('x.mcap', empty, 'empty file'),
    'folder': ('x', folder, 'no metadata.yaml'),
    'no submaps': ('x.mcap', without_submaps, f'no topic of type {SUBMAP}, only {BUNDLE}'),
    'metadata': ('x', broken_metadata, 'truncated or damaged'),
    'lost file': ('x', lost_file, 'truncated or damaged: Some database files are missing'),
    'database': ('x', broken_database, 'truncated or damaged'),
    'profile': ('x.mcap', foreign_profile, 'truncated or damaged: Profile is not ros2'),
}


@pytest.mark.parametrize('case', BAD_BAGS)
def test_bad_bags_are_one_line(tmp_path: Path, case: str) -> None:
    name, make, reason = BAD_BAGS[case]
    path = make(tmp_path / name)
    with pytest.raises(BagError) as caught:
        list(read_submaps(path))
    assert str(caught.value).startswith(f'{path}: {reason}')
    assert '\n' not in str(caught.value)


def test_a_truncated_file_is_an_error_wherever_it_ends(bag: Path) -> None:
    data = bag.read_bytes()
    for length in np.linspace(1, len(data) - 1, 60, dtype=int):
        bag.write_bytes(data[:length])
        with pytest.raises(BagError) as caught:
            list(read_submaps(bag))
        assert str(caught.value).startswith(f'{bag}: ')


@pytest.mark.parametrize('seed', range(3))
def test_damaged_files_raise_nothing_else(bag: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = bag.read_bytes()
    for _ in range(60):
        damaged = bytearray(data)
        for place in rng.integers(8, len(damaged), 3):
            damaged[place] = rng.integers(256)
        bag.write_bytes(damaged)
        try:
            list(read_submaps(bag))
        except BagError as err:
            assert '\n' not in str(err)


def test_one_bad_bag_among_good_ones_is_named_at_once(bag: Path, tmp_path: Path) -> None:
    other = not_a_bag(tmp_path / 'other.mcap')
    with pytest.raises(BagError, match=r'other\.mcap'):
        Recording([bag, other]).__enter__()


def test_failure_leaves_nothing_and_keeps_what_was_there(tmp_path: Path) -> None:
    target = tmp_path / 'bag.mcap'
    write_submaps(target, entries(10))
    before = target.read_bytes()

    def failing() -> Any:
        yield entries(11)[0]
        raise RuntimeError('the simulation broke')

    with pytest.raises(RuntimeError, match='broke'):
        write_submaps(target, failing())
    assert target.read_bytes() == before
    assert os.listdir(tmp_path) == ['bag.mcap']  # noqa: PTH208


@pytest.mark.parametrize('name', ['missing/bag.mcap', 'folder', '/dev/null/bag.mcap'])
def test_unwritable_paths_are_one_line(tmp_path: Path, name: str) -> None:
    (tmp_path / 'folder').mkdir()
    with pytest.raises(OutputError) as caught:
        write_submaps(tmp_path / name, entries(12, 1))
    assert str(caught.value).startswith(f'{tmp_path / name}: ')
    assert '\n' not in str(caught.value)
    assert isinstance(caught.value, MapMergeError)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ['folder']


def test_a_full_disk_is_one_line(tmp_path: Path) -> None:
    _, hard = limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OutputError, match=r'bag\.mcap: File too large'):
            write_submaps(tmp_path / 'bag.mcap', entries(13, 60))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_errors_of_other_files_keep_their_name(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), record(tmp_path / 'bag.mcap'):
        (tmp_path / 'other').read_bytes()
    assert not list(tmp_path.iterdir())
