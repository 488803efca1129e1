# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What can still be read of a damaged .mcap file: broken off, or with other bytes inside."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Attachment, Channel, Chunk, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from mapmerge_ros.io.bags import BagError
from mapmerge_ros.io.output import replacing


@dataclass(slots=True)
class Salvaged:
    """What was found in a damaged recording, and what was not."""

    topics: dict[str, int] = field(default_factory=dict)
    """Messages by topic"""
    lost: int = 0
    """Chunks, and messages of topics that are not known, which cannot be read"""
    first_ns: int = 0
    """Log time of the first message"""
    last_ns: int = 0
    """Log time of the last message"""
    broke_off: str = ''
    """Why there was no more; empty if the file is read to its end"""

    @property
    def messages(self) -> int:
        """Messages of all topics."""
        return sum(self.topics.values())

    @property
    def is_whole(self) -> bool:
        """Whether nothing was wrong with the file."""
        return not (self.broke_off or self.lost)


def salvage(source: Path, target: Path) -> Salvaged:
    """
    Copy everything that can be read of an .mcap file into a new, whole one.

    A chunk is read as a whole or not at all: of the rest of a damaged one nothing is certain.

    Raises
    ------
    BagError
        There is no such file, or not one message can be read.
    OutputError
        The new file cannot be written; nothing is left behind.

    """
    found = Salvaged()
    try:
        stream = source.open('rb')
    except OSError as err:
        raise BagError(f'{source}: {err.strerror}: check the path') from err
    with stream, replacing(target) as out:
        reader = StreamReader(
            stream, emit_chunks=True, record_size_limit=max(source.stat().st_size, 1)
        )
        copy = _Copy(Writer(out, compression=CompressionType.NONE), found)
        for record in _readable(reader, found):
            copy.add(record)
        copy.finish()
        if not found.messages:
            reason = found.broke_off or 'it holds no messages'
            raise BagError(f'{source}: nothing can be read: {reason}')
    return found


def _readable(reader: StreamReader, found: Salvaged) -> Iterator[McapRecord]:
    """Records one after the other, those inside chunks too, until there are no more."""
    records = reader.records
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except Exception as err:  # damaged bytes raise anything from struct.error to TypeError
            found.broke_off = ' '.join(str(err).split()) or type(err).__name__
            return
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            inside = breakup_chunk(record, validate_crc=True)
        except Exception:  # see above
            found.lost += 1
            continue
        yield from inside


class _Copy:
    """Writes records under numbers of its own."""

    def __init__(self, writer: Writer, found: Salvaged) -> None:
        self._writer, self._found = writer, found
        self._started = False
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, tuple[int, str]] = {}

    def add(self, record: McapRecord) -> None:
        """Append what belongs to the data; indexes are made anew."""
        if isinstance(record, Header):
            self._start(record.profile, record.library)
        elif isinstance(record, Schema) and record.id not in self._schemas:
            self._schemas[record.id] = self._writer.register_schema(
                record.name, record.encoding, record.data
            )
        elif isinstance(record, Channel) and record.id not in self._channels:
            self._add_channel(record)
        elif isinstance(record, Message):
            self._add_message(record)
        elif isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )

    def finish(self) -> None:
        """Write the index."""
        self._start('ros2', 'mapmerge_ros')
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _start(self, profile: str, library: str) -> None:
        if not self._started:
            self._writer.start(profile=profile, library=library)
        self._started = True

    def _add_channel(self, record: Channel) -> None:
        if record.schema_id not in self._schemas:
            return  # its schema was lost: its messages cannot be read
        number = self._writer.register_channel(
            record.topic,
            record.message_encoding,
            self._schemas[record.schema_id],
            record.metadata,
        )
        self._channels[record.id] = number, record.topic

    def _add_message(self, record: Message) -> None:
        found = self._found
        if record.channel_id not in self._channels:
            found.lost += 1
            return
        number, topic = self._channels[record.channel_id]
        self._writer.add_message(
            number, record.log_time, record.data, record.publish_time, record.sequence
        )
        earlier = found.first_ns if found.messages else record.log_time
        found.first_ns = min(earlier, record.log_time)
        found.last_ns = max(found.last_ns, record.log_time)
        found.topics[topic] = found.topics.get(topic, 0) + 1
