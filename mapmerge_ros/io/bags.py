# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings read: .mcap files and rosbag2 folders (mcap or sqlite3), in time order."""

from __future__ import annotations

import heapq
from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from mapmerge_ros.errors import MapMergeError
from mapmerge_ros.io.codec import decode_submap
from mapmerge_ros.io.definitions import foreign_definition
from mapmerge_ros.io.fields import InvalidMessage
from mapmerge_ros.io.typestore import SUBMAP
from mapmerge_ros.submap import SubMap

_MAGIC = {'.mcap': b'\x89MCAP0\r\n', '.db3': b'SQLite format 3\x00'}

_Raw = tuple[Connection, int, bytes]


class BagError(MapMergeError):
    """A recording cannot be read; the message names the file."""


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """One message of a recording: a sub-map, or the reason why it is none."""

    log_time_ns: int
    topic: str
    size_bytes: int
    submap: SubMap | None
    refusal: str = ''


class Recording:
    """
    The sub-maps of one or several bags, merged in time order.

    A context manager; it may be iterated over any number of times while it is open. Messages
    of equal time keep the order of the paths. At most one chunk of each file is in memory.

    Raises
    ------
    BagError
        On entering: a path is no bag, is damaged, holds no sub-maps or those of another version
        of the message. On iterating: the file is damaged further on.

    """

    def __init__(self, paths: Path | str | Sequence[Path | str]) -> None:
        several = [paths] if isinstance(paths, (str, Path)) else paths
        self._paths = [Path(path) for path in several]
        self._stack = ExitStack()
        self._bags: list[tuple[Path, Reader, list[Connection]]] = []

    def __enter__(self) -> Recording:
        with ExitStack() as stack:
            for path in self._paths:
                reader = _open(path)
                stack.callback(reader.close)
                self._bags.append((path, reader, _connections(path, reader, SUBMAP)))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bags.clear()
        self._stack.close()

    @property
    def total(self) -> int:
        """Number of messages."""
        return sum(topic.msgcount for _, _, topics in self._bags for topic in topics)

    def __iter__(self) -> Iterator[Recorded]:
        streams = [_stream(*bag) for bag in self._bags]
        return heapq.merge(*streams, key=lambda recorded: recorded.log_time_ns)


def read_submaps(paths: Path | str | Sequence[Path | str]) -> Iterator[Recorded]:
    """
    Every message of type SubMap of the bags, in time order; see `Recording`.

    Raises
    ------
    BagError
        A path cannot be read as a recording of sub-maps.

    """
    with Recording(paths) as recording:
        yield from recording


def read_raw(path: Path, typename: str) -> Iterator[bytes]:
    """
    Bytes of every message of one type in a bag, in time order.

    Raises
    ------
    BagError
        It cannot be read, or has no topic of this type.

    """
    with closing(_open(path)) as reader:
        for _, _, raw in _messages(path, reader, _connections(path, reader, typename)):
            yield raw


def _open(path: Path) -> Reader:
    _check_kind(path)
    try:
        reader = Reader(path)
        reader.open()
    except Exception as err:  # a damaged file raises anything from struct.error to TypeError
        raise _damaged(path, err) from err
    return reader


def _check_kind(path: Path) -> None:
    try:
        if path.is_dir():
            if not (path / 'metadata.yaml').exists():
                raise BagError(f'{path}: no metadata.yaml in this folder: run ros2 bag reindex')
            return
        with path.open('rb') as stream:
            start = stream.read(16)
    except OSError as err:
        raise BagError(f'{path}: {err.strerror}: check the path') from err
    magic = _MAGIC.get(path.suffix)
    if magic is None:
        raise BagError(f'{path}: not a bag: give an .mcap file or a rosbag2 folder')
    if not start:
        raise BagError(f'{path}: empty file: record again')
    if not start.startswith(magic):
        raise BagError(f'{path}: not a {path.suffix} file: its first bytes are others')


def _damaged(path: Path, err: Exception) -> BagError:
    reason = ' '.join(str(err).split()) or type(err).__name__
    remedy = ': `mapmerge salvage` saves what can be read' if path.suffix == '.mcap' else ''
    return BagError(f'{path}: truncated or damaged: {reason[:200].rstrip(".")}{remedy}')


def _connections(path: Path, reader: Reader, typename: str) -> list[Connection]:
    found = [topic for topic in reader.connections if topic.msgtype == typename]
    if not found:
        others = sorted({topic.msgtype for topic in reader.connections})
        word = typename.rpartition('/')[2].lower()
        raise BagError(
            f'{path}: no topic of type {typename}, only {", ".join(others) or "nothing"}: '
            f'record the {word} topics'
        )
    for connection in found:
        if reason := foreign_definition(connection):
            raise BagError(f'{path}: {reason}')
    return found


def _stream(path: Path, reader: Reader, connections: list[Connection]) -> Iterator[Recorded]:
    for connection, log_time_ns, raw in _messages(path, reader, connections):
        yield _decoded(log_time_ns, connection.topic, raw)


def _messages(path: Path, reader: Reader, connections: list[Connection]) -> Iterator[_Raw]:
    messages: Generator[_Raw, Any, None] = reader.messages(connections)
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        except Exception as err:  # see _open
            raise _damaged(path, err) from err
        yield message


def _decoded(log_time_ns: int, topic: str, raw: bytes) -> Recorded:
    try:
        return Recorded(log_time_ns, topic, len(raw), decode_submap(raw))
    except InvalidMessage as err:
        return Recorded(log_time_ns, topic, len(raw), None, str(err))
