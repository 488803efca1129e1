# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A damaged recording gives back all that can be read of it, and nothing that it did not hold."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from recordings import Entry, entries

from mapmerge_ros.cli.main import main
from mapmerge_ros.io import BagError, encode_submap, read_submaps
from mapmerge_ros.io.bags import read_raw
from mapmerge_ros.io.salvage import salvage
from mapmerge_ros.io.typestore import SUBMAP, schema_text

CHUNK = 8_000


def write(path: Path, recorded: list[Entry], compression: CompressionType) -> list[bytes]:
    """A recording of many chunks; its messages."""
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=CHUNK, compression=compression)
        writer.start(profile='ros2', library='test')
        schema = writer.register_schema(SUBMAP, 'ros2msg', schema_text(SUBMAP).encode())
        channels: dict[str, int] = {}
        for topic, log_time_ns, submap in recorded:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
            raw = encode_submap(submap)
            writer.add_message(channels[topic], log_time_ns, raw, log_time_ns)
        writer.add_metadata('site', {'weather': 'fine'})
        writer.finish()  # type: ignore[no-untyped-call]
    return [encode_submap(submap) for _, _, submap in recorded]


@pytest.fixture(params=[CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD])
def bag(tmp_path: Path, request: pytest.FixtureRequest) -> tuple[Path, list[bytes]]:
    path = tmp_path / 'bag.mcap'
    return path, write(path, entries(0, 24), request.param)


def test_a_whole_recording_stays_what_it_is(bag: tuple[Path, list[bytes]]) -> None:
    path, messages = bag
    target = path.with_name('target.mcap')
    found = salvage(path, target)
    assert found.is_whole
    assert found.messages == len(messages)
    assert found.last_ns - found.first_ns == 23 * 10**9
    assert list(read_raw(target, SUBMAP)) == messages
    for before, after in zip(read_submaps(path), read_submaps(target), strict=True):
        assert (before.topic, before.log_time_ns) == (after.topic, after.log_time_ns)
    assert b'weather' in target.read_bytes()


def test_what_came_before_the_break_is_there(bag: tuple[Path, list[bytes]]) -> None:
    path, messages = bag
    data, target = path.read_bytes(), path.with_name('target.mcap')
    counts = []
    for length in np.linspace(1, len(data) - 1, 40, dtype=int):
        path.write_bytes(data[:length])
        target.unlink(missing_ok=True)
        try:
            found = salvage(path, target)
        except BagError as err:
            assert 'nothing can be read' in str(err)
            assert not target.exists()
            counts.append(0)
            continue
        saved = list(read_raw(target, SUBMAP))
        assert found.messages == len(saved)
        assert found.broke_off
        assert saved == messages[: len(saved)]
        counts.append(len(saved))
    assert counts == sorted(counts)
    assert counts[-1] == len(messages)  # only its index is missing
    assert len(set(counts)) > 5


@pytest.mark.parametrize('seed', range(3))
def test_wrong_bytes_cost_their_chunk_and_never_make_a_message(
    bag: tuple[Path, list[bytes]], seed: int
) -> None:
    path, messages = bag
    rng, data = np.random.default_rng(seed), path.read_bytes()
    target, whole = path.with_name('target.mcap'), 0
    for _ in range(20):
        damaged = bytearray(data)
        damaged[rng.integers(200, len(data) // 2)] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            salvage(path, target)
        except BagError:
            continue
        saved = list(read_raw(target, SUBMAP))
        assert set(saved) <= set(messages)
        whole += len(saved) >= len(messages) - 6
    assert whole > 10  # most bytes are in a chunk, and the others are read


def test_the_command_says_what_there_was(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, target = tmp_path / 'bag.mcap', tmp_path / 'target.mcap'
    write(path, entries(1, 24), CompressionType.NONE)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert main(['replay', str(path), '--out', str(tmp_path / 'out')]) == 1
    assert '`mapmerge salvage` saves what can be read' in capsys.readouterr().err
    assert main(['salvage', str(path), '-o', str(target)]) == 0
    printed = capsys.readouterr().out
    assert '/drone0/submap: ' in printed
    assert 'it breaks off there' in printed
    assert main(['info', str(target)]) == 0
    path.write_bytes(data)
    assert main(['salvage', str(path), '-o', str(target)]) == 0
    assert 'nothing is wrong with the recording' in capsys.readouterr().out


def test_misuse_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / 'bag.mcap'
    path.write_text('Hello, this is not a recording at all.')
    for command, code, words in (
        ([path, '-o', path], 2, 'is the damaged file itself'),
        ([path, '-o', tmp_path / 'x.bag'], 1, 'has to end in .mcap'),
        ([path, '-o', tmp_path / 'x.mcap'], 1, 'nothing can be read'),
        ([tmp_path / 'y.mcap', '-o', tmp_path / 'x.mcap'], 1, 'check the path'),
    ):
        assert main(['salvage', *map(str, command)]) == code
        error = capsys.readouterr().err
        assert words in error
        assert error.count('\n') == 1
    assert sorted(x.name for x in tmp_path.iterdir()) == ['bag.mcap']


def test_of_a_writer_that_was_killed_the_part_is_read(tmp_path: Path) -> None:
    """As `mapmerge record` has it: a hidden part, without an end."""
    target = tmp_path / 'target.mcap'
    script = (
        'import sys, time\n'
        'from recordings import entries\n'
        'from mapmerge_ros.io import record\n'
        'with record(sys.argv[1]) as recorder:\n'
        '    while True:\n'
        '        for entry in entries(2, 40):\n'
        '            recorder.write_submap(*entry)\n'
    )
    writer = subprocess.Popen(
        [sys.executable, '-c', script, str(tmp_path / 'site.mcap')], cwd=Path(__file__).parent
    )
    try:
        deadline_s = time.monotonic() + 60.0
        while not any(x.stat().st_size > 3e6 for x in tmp_path.glob('.site.mcap.*.part')):
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
    finally:
        writer.kill()
        writer.wait()
    (part,) = tmp_path.glob('.site.mcap.*.part')
    found = salvage(part, target)
    assert found.broke_off
    assert found.messages > 40
    known = {encode_submap(submap) for _, _, submap in entries(2, 40)}
    assert set(read_raw(target, SUBMAP)) <= known
