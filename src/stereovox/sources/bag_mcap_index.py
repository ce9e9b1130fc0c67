# SPDX-License-Identifier: Apache-2.0
"""Where the messages of an `.mcap` file stand: by the index at its end, else by going through it."""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MissingExtra, SourceError
from stereovox.sources.bag_mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEAD,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    SCHEMA,
    START,
    STATISTICS,
    Channel,
    Chunk,
    McapBytes,
    Record,
    read_channel,
    read_chunk_index,
    read_message_index,
    read_schema,
    record,
)
from stereovox.sources.bag_messages import Wire
from stereovox.sources.bag_unpack import most_unpacked

TAIL = HEAD + 20 + len(START)
"""Bytes of the last record and of what ends a file."""
LOOSE = -1
"""In the place of its chunk's: a message that stands in none."""
MAX_RECORDS = 10_000_000
"""More than these are not gone through: hours of a robot, and 240 MB of memory if all are messages."""
LATEST = 2**63 - 1

Places = NDArray[np.int64]
"""(N, 3) int64: time in nanoseconds, start of the chunk or `LOOSE`, start of the message in its chunk or the file."""


class Summary:
    """The index at the end of a file; raises ValueError where it is missing, damaged or not complete."""

    def __init__(self, file: McapBytes):
        self._file = file
        self.channels: dict[int, Channel] = {}
        self._chunks: list[Chunk] = []
        self._seen: set[int] = set()
        start, data = _summary(file)
        count = self._read(data, start)
        counted = {key for chunk in self._chunks for key, number in chunk.counts.items() if number}
        if count != sum(sum(chunk.counts.values()) for chunk in self._chunks) or not counted <= self._seen:
            raise ValueError("the index is not complete")
        self.channels = {key: known for key, known in self.channels.items() if key in counted}

    def places(self, topic: str) -> Places:
        """Return where the messages of `topic` stand; raises ValueError for a damaged index."""
        parts = [np.empty((0, 3), np.int64)]
        for channel in (key for key, known in self.channels.items() if known.topic == topic):
            parts.extend(self._in_chunk(chunk, channel) for chunk in self._chunks if chunk.counts.get(channel))
        return np.concatenate(parts)

    def _read(self, data: bytes, limit: int) -> int:
        """Take in the summary, of a file whose chunks end at `limit`, and return the number of messages."""
        schemas, count, end = {}, None, 0
        for found in _records(data):
            wire = Wire(memoryview(data)[found.start : found.end], cdr=False)
            if found.kind == SCHEMA:
                number, name = read_schema(wire)
                schemas[number] = name
            elif found.kind == CHANNEL:
                number, channel = read_channel(wire, schemas)
                self._seen.add(number)
                if channel is not None:
                    self.channels[number] = channel
            elif found.kind == CHUNK_INDEX:
                chunk = read_chunk_index(wire)
                if not end <= chunk.start < chunk.end <= limit:  # one after the other, as they were written
                    raise ValueError("the index is damaged")
                self._chunks.append(chunk)
                end = chunk.end
            elif found.kind == STATISTICS:
                count = wire.number("Q")
        if count is None:
            raise ValueError("the index is not complete")
        return count

    def _in_chunk(self, chunk: Chunk, channel: int) -> Places:
        file = self._file
        entries = read_message_index(file.fields(file.record(chunk.indexes[channel]), MESSAGE_INDEX), channel)
        if len(entries) != chunk.counts[channel] or entries["time"].max() > LATEST:
            raise ValueError("the index is damaged")
        start = np.full(len(entries), chunk.start)
        return np.stack([entries["time"].astype(np.int64), start, entries["offset"].astype(np.int64)], axis=1)


class Scanned:
    """The messages found by going through a file from its beginning, as far as it is whole.

    whole: how far that is, in bytes; complete: whether the file ends there as it should; damaged: chunks left out.
    Raises SourceError for more records than can be kept in mind, MissingExtra where chunks cannot be unpacked.
    """

    def __init__(self, file: McapBytes):
        self.channels: dict[int, Channel] = {}
        self.whole, self.complete, self.damaged = len(START), False, 0
        self._schemas: dict[int, str] = {}
        self._found: dict[int, array[int]] = {}
        self._file, self._count, self._swollen = file, 0, 0
        self._go_through()
        self.channels = {key: known for key, known in self.channels.items() if key in self._found}

    def places(self, topic: str) -> Places:
        """Return where the messages of `topic` stand."""
        keys = [key for key, known in self.channels.items() if known.topic == topic]
        return np.concatenate([np.frombuffer(self._found[key], np.int64).reshape(-1, 3) for key in keys])

    def _go_through(self) -> None:
        while True:
            try:
                found = self._file.record(self.whole)
                if found.kind in (DATA_END, FOOTER):
                    self.complete = True
                    return
                self._take_in(found)
            except (MissingExtra, SourceError):
                raise
            except ValueError:
                return
            self.whole = found.end

    def _take_in(self, found: Record) -> None:
        if found.kind == CHUNK:
            try:
                inner = self._file.chunk(found)
                self._swollen += len(inner)
                if self._swollen > most_unpacked(self._file.size):
                    raise SourceError(f"{self._file.path}: its chunks unpack to an absurd size; record it again")
                for part in _records(inner):
                    self._note(part, inner[part.start : min(part.end, part.start + self._needed(part))], found)
            except (MissingExtra, SourceError):
                raise
            except ValueError:
                self.damaged += 1
        elif found.kind in (SCHEMA, CHANNEL, MESSAGE):
            self._note(found, self._file.at(found.start, min(found.end, found.start + self._needed(found))), None)

    @staticmethod
    def _needed(found: Record) -> int:
        if found.kind == MESSAGE:
            return MESSAGE_HEAD
        return found.end - found.start if found.kind in (SCHEMA, CHANNEL) else 0

    def _note(self, found: Record, fields: bytes, chunk: Record | None) -> None:
        """Take in a schema, channel or message."""
        self._count += 1
        if self._count > MAX_RECORDS:
            cure = "index it with 'mcap recover'"
            raise SourceError(f"{self._file.path}: more than {MAX_RECORDS} records without an index; {cure}")
        if found.kind == SCHEMA:
            number, name = read_schema(Wire(fields, cdr=False))
            self._schemas[number] = name
        elif found.kind == CHANNEL:
            number, channel = read_channel(Wire(fields, cdr=False), self._schemas)
            if channel is not None:
                self.channels[number] = channel
        elif found.kind == MESSAGE:
            self._note_message(found, fields, chunk)

    def _note_message(self, found: Record, fields: bytes, chunk: Record | None) -> None:
        if len(fields) < MESSAGE_HEAD:
            raise ValueError("a message without its head")
        number, _, time, _ = struct.unpack("<HIQQ", fields)
        if number not in self.channels:
            return
        if time > LATEST:
            raise ValueError("a time that cannot be")
        place = found.start - HEAD
        self._found.setdefault(number, array("q")).extend((time, chunk.start - HEAD if chunk else LOOSE, place))


def _summary(file: McapBytes) -> tuple[int, bytes]:
    """Return start and records of the summary of a whole file; raises ValueError where there is none."""
    tail = file.at(file.size - TAIL, file.size)
    if not tail.endswith(START):
        raise ValueError("the file is cut off")
    found = record(tail[:HEAD], 0, TAIL)
    wire = Wire(tail[HEAD:], cdr=False)
    start, _, checksum = *wire.numbers("Q", 2), wire.number()
    if found.kind != FOOTER or not start:
        raise ValueError("there is no index")
    data = file.at(start, file.size - TAIL)
    if checksum and zlib.crc32(data + tail[: HEAD + 16]) != checksum:
        raise ValueError("the index is damaged")
    return start, data


def _records(data: bytes) -> Iterator[Record]:
    """Yield the records of a chunk or summary; raises ValueError where they do not fill it."""
    at = 0
    while at < len(data):
        found = record(data[at : at + HEAD], at, len(data))
        yield found
        at = found.end
