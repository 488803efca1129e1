# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""
How fast recordings of sub-maps are read, decoded and checked, as `mapmerge replay` does it.

    python benchmarks/bag_replay.py

One thread, file in the page cache, opening included. Time on the clock is that of this machine
with whatever else runs on it; CPU time is what the work costs. Paired in one run.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from mcap.writer import CompressionType, Writer
from messages_184kb import next_revision, submap
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter

from mapmerge_ros.io import encode_submap, read_submaps, write_submaps
from mapmerge_ros.io.typestore import SUBMAP, schema_text, typestore
from mapmerge_ros.submap import SubMap

Entries = Iterator[tuple[str, int, SubMap]]


@dataclass(frozen=True)
class Pass:
    """One way through a recording."""

    size_bytes: int
    wall_s: float
    cpu_s: float


def entries(messages: int, topics: int) -> Entries:
    """Robots in turns, each time with the next revision."""
    newest = [submap(k, 0) for k in range(topics)]
    for number in range(messages):
        drone = number % topics
        newest[drone] = next_revision(newest[drone])
        yield f'/drone{drone}/submap', 1_000_000 * (number + 1), newest[drone]


def own_recording(path: Path, recorded: Entries) -> Path:
    """As this package records."""
    write_submaps(path, recorded)
    return path


def compressed_recording(kind: CompressionType) -> Callable[[Path, Entries], Path]:
    """As others may record: the same file with compressed chunks."""

    def write(path: Path, recorded: Entries) -> Path:
        with path.open('wb') as stream:
            writer = Writer(stream, compression=kind)
            writer.start(profile='ros2')
            schema = writer.register_schema(SUBMAP, 'ros2msg', schema_text(SUBMAP).encode())
            channels: dict[str, int] = {}
            for topic, log_time_ns, item in recorded:
                if topic not in channels:
                    channels[topic] = writer.register_channel(topic, 'cdr', schema)
                raw = encode_submap(item)
                writer.add_message(channels[topic], log_time_ns, raw, publish_time=log_time_ns)
            writer.finish()
        return path

    return write


def sqlite_recording(path: Path, recorded: Entries) -> Path:
    """As older distributions of ROS 2 record."""
    folder = path.with_suffix('')
    with FolderWriter(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topics = {}
        for topic, log_time_ns, item in recorded:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, SUBMAP, typestore=typestore())
            writer.write(topics[topic], log_time_ns, encode_submap(item))
    return folder


KINDS: dict[str, Callable[[Path, Entries], Path]] = {
    'mcap, own recorder': own_recording,
    'rosbag2 sqlite3': sqlite_recording,
    'mcap, LZ4': compressed_recording(CompressionType.LZ4),
    'mcap, zstd': compressed_recording(CompressionType.ZSTD),
}


def read(path: Path) -> Pass:
    """Read, decode and check every message of a recording."""
    wall_s, cpu_s, size_bytes = time.perf_counter(), time.process_time(), 0
    for recorded in read_submaps(path):
        if recorded.submap is None:
            raise ValueError(recorded.refusal)
        size_bytes += recorded.size_bytes
    return Pass(size_bytes, time.perf_counter() - wall_s, time.process_time() - cpu_s)


def measure(messages: int, topics: int, repeats: int) -> str:
    """Markdown table of all kinds of recording."""
    lines = [
        '| recording | size on disk / messages | MB/s on the clock | MB/s of CPU time |',
        '|---|---|---|---|',
    ]
    with tempfile.TemporaryDirectory() as folder:
        paths = {
            name: make(Path(folder) / f'{k}.mcap', entries(messages, topics))
            for k, (name, make) in enumerate(KINDS.items())
        }
        found: dict[str, list[Pass]] = {name: [] for name in paths}
        for _ in range(repeats):
            for name, path in paths.items():
                found[name].append(read(path))
        for name, path in paths.items():
            lines.append(_line(name, _size_bytes(path), found[name]))
    return '\n'.join(lines)


def _line(name: str, size_bytes: int, passes: list[Pass]) -> str:
    wall = median(item.size_bytes / item.wall_s for item in passes) * 1e-6
    cpu = median(item.size_bytes / item.cpu_s for item in passes) * 1e-6
    return f'| {name} | {size_bytes / passes[0].size_bytes:.2f} | {wall:.0f} | {cpu:.0f} |'


def _size_bytes(path: Path) -> int:
    files = [path] if path.is_file() else path.iterdir()
    return sum(file.stat().st_size for file in files)


def main(argv: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--messages', type=int, default=1600)
    parser.add_argument('--topics', type=int, default=16)
    parser.add_argument('--repeats', type=int, default=5)
    args = parser.parse_args(argv)
    print(measure(args.messages, args.topics, args.repeats))
    return 0


if __name__ == '__main__':
    sys.exit(main())
