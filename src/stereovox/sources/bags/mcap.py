# SPDX-License-Identifier: Apache-2.0
"""Recordings in one `.mcap` file (mcap.dev/spec): read by the index, or by scanning a file without one."""

from __future__ import annotations

import struct
import threading
import zlib
from array import array
from collections import OrderedDict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, MissingExtra, SourceError
from stereovox.sources.bags.files import MAX_BYTES, BagFile, decompress, decompress_message, max_unpacked, one_line
from stereovox.sources.bags.messages import Wire

START = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, STATISTICS = 2, 3, 4, 5, 6, 7, 8, 11
DATA_END = 15
HEAD = 9
"""Bytes before a record's fields: opcode and length."""
MESSAGE_HEAD = 22
"""Bytes of a message before its data: channel, number, times of recording and sending."""
INDEX_HEAD = HEAD + 6
"""Bytes of a message index before its entries of 16 bytes each."""
MIN_CHUNK_BYTES = HEAD + 40
"""Bytes of an empty chunk."""
ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])
ENCODINGS = {"cdr": True, "ros1": False}
"""Supported message encodings, and whether each is ROS 2's; others (JSON, protobuf) are not ROS messages."""
TAIL = HEAD + 20 + len(START)
"""Bytes of the last record and of the magic that ends a file."""
NO_CHUNK = -1
"""Chunk of a message outside all chunks."""
MAX_RECORDS = 10_000_000
"""Most records that a scan accepts: hours of a robot, and 240 MB of memory if all are messages."""
MAX_STAMP_NS = 2**63 - 1
Places = NDArray[np.int64]
"""(N, 3) int64: time in nanoseconds, start of the chunk or `NO_CHUNK`, start of the message in its chunk or file."""
CHUNKS = 4
"""Decompressed chunks kept: enough for an image, its camera and the poses around it."""


class McapFile(BagFile):
    """A recording of ROS 2, or of ROS 1 converted to `.mcap`: chunks uncompressed or with zstd or lz4.

    Read by the index at its end. If that is missing, as after an interrupted recording, or unusable, the file is
    scanned once when it is opened, its intact messages count, and `notes` report it. Raises SourceError for a file
    without anything readable.
    """

    def __init__(self, path: Path):
        self.path = path
        self.notes = ()
        self._bytes = McapBytes(path)
        self._lock = threading.Lock()
        self._chunks: OrderedDict[int, bytes] = OrderedDict()
        self._places: dict[str, Places] = {}
        try:
            self._index: Summary | ScannedFile = Summary(self._bytes)
        except ValueError as error:
            self._index = self._scan(str(error))
        self.types = {channel.topic: channel.type for channel in self._index.channels.values()}

    def stamps(self, topic: str) -> NDArray[np.int64]:
        """Return the times at which the messages of `topic` were recorded; raises SourceError for a damaged file."""
        return self._of(topic)[:, 0]

    def read(self, topic: str, i: int) -> Wire:
        """Return message `i`; raises FrameRefused `unreadable` if the file is damaged."""
        try:
            with self._lock:
                time, chunk, start = self._of(topic)[i].tolist()
                number, recorded, data = self._message(chunk, start)
            channel = self._index.channels.get(number)
            if channel is None or channel.topic != topic or recorded != time:
                raise ValueError("the index points to something else")
            return Wire(decompress_message(bytes(data), MAX_BYTES), cdr=channel.cdr)
        except (OSError, SourceError, ValueError, MemoryError) as error:
            raise FrameRefused("unreadable", f"{self.path}: message {i} of {topic}: {one_line(error)}") from None

    def _scan(self, why: str) -> ScannedFile:
        """Scan the file and note the result."""
        found = ScannedFile(self._bytes)
        if not found.complete and not found.channels:
            raise SourceError(f"{self.path}: cut off or damaged before the first message; record or copy it again")
        rest = (
            ""
            if found.complete
            else f"; cut off or damaged at byte {found.whole} of {self._bytes.size}, the rest is lost"
        )
        lost = f"; {found.damaged} damaged chunks left out" if found.damaged else ""
        self.notes = (f"{self.path}: {one_line(why)}: scanned from the beginning{lost}{rest}",)
        return found

    def _of(self, topic: str) -> Places:
        """Return the positions of a topic's messages, in time order."""
        if topic not in self._places:
            try:
                places = self._index.places(topic)
            except (OSError, ValueError) as error:
                cure = "repair it with 'mcap recover' or record it again"
                raise SourceError(f"{self.path}: topic {topic}: {one_line(error)}; {cure}") from None
            self._places[topic] = places[np.argsort(places[:, 0], kind="stable")]
        return self._places[topic]

    def _message(self, chunk: int, start: int) -> tuple[int, int, memoryview]:
        if chunk != NO_CHUNK:
            return message_at(self._chunk(chunk), start)
        found = self._bytes.record(start)
        return message_at(self._bytes.at(start, found.end), 0)

    def _chunk(self, start: int) -> bytes:
        if start not in self._chunks:
            self._chunks[start] = self._bytes.chunk(self._bytes.record(start))
            while len(self._chunks) > CHUNKS:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(start)
        return self._chunks[start]


class Summary:
    """The index at the end of a file; raises ValueError if it is missing, damaged or incomplete."""

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
        """Return the positions of the messages of `topic`; raises ValueError for a damaged index."""
        parts = [np.empty((0, 3), np.int64)]
        for channel in (key for key, known in self.channels.items() if known.topic == topic):
            parts.extend(self._in_chunk(chunk, channel) for chunk in self._chunks if chunk.counts.get(channel))
        return np.concatenate(parts)

    def _read(self, data: bytes, limit: int) -> int:
        """Read the summary of a file whose chunks end at `limit`, and return the number of messages."""
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
                if not end <= chunk.start < chunk.end <= limit:  # in the order in which they were written
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
        if len(entries) != chunk.counts[channel] or entries["time"].max() > MAX_STAMP_NS:
            raise ValueError("the index is damaged")
        start = np.full(len(entries), chunk.start)
        return np.stack([entries["time"].astype(np.int64), start, entries["offset"].astype(np.int64)], axis=1)


class ScannedFile:
    """The messages found by scanning a file from its beginning, as far as it is intact.

    whole: intact bytes; complete: whether the file ends properly there; damaged: chunks skipped. Raises SourceError
    for more records than memory allows, MissingExtra if chunks cannot be decompressed.
    """

    def __init__(self, file: McapBytes):
        self.channels: dict[int, Channel] = {}
        self.whole, self.complete, self.damaged = len(START), False, 0
        self._schemas: dict[int, str] = {}
        self._found: dict[int, array[int]] = {}
        self._file, self._count, self._unpacked_bytes = file, 0, 0
        self._scan_records()
        self.channels = {key: known for key, known in self.channels.items() if key in self._found}

    def places(self, topic: str) -> Places:
        """Return the positions of the messages of `topic`."""
        keys = [key for key, known in self.channels.items() if known.topic == topic]
        return np.concatenate([np.frombuffer(self._found[key], np.int64).reshape(-1, 3) for key in keys])

    def _scan_records(self) -> None:
        while True:
            try:
                found = self._file.record(self.whole)
                if found.kind in (DATA_END, FOOTER):
                    self.complete = True
                    return
                self._add_record(found)
            except (MissingExtra, SourceError):
                raise
            except ValueError:
                return
            self.whole = found.end

    def _add_record(self, found: Record) -> None:
        if found.kind == CHUNK:
            try:
                inner = self._file.chunk(found)
                self._unpacked_bytes += len(inner)
                if self._unpacked_bytes > max_unpacked(self._file.size):
                    raise SourceError(f"{self._file.path}: its chunks unpack to an absurd size; record it again")
                for part in _records(inner):
                    self._add_fields(
                        part, inner[part.start : min(part.end, part.start + self._bytes_needed(part))], found
                    )
            except (MissingExtra, SourceError):
                raise
            except ValueError:
                self.damaged += 1
        elif found.kind in (SCHEMA, CHANNEL, MESSAGE):
            self._add_fields(
                found, self._file.at(found.start, min(found.end, found.start + self._bytes_needed(found))), None
            )

    @staticmethod
    def _bytes_needed(found: Record) -> int:
        if found.kind == MESSAGE:
            return MESSAGE_HEAD
        return found.end - found.start if found.kind in (SCHEMA, CHANNEL) else 0

    def _add_fields(self, found: Record, fields: bytes, chunk: Record | None) -> None:
        """Add a schema, channel or message."""
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
            self._add_message(found, fields, chunk)

    def _add_message(self, found: Record, fields: bytes, chunk: Record | None) -> None:
        if len(fields) < MESSAGE_HEAD:
            raise ValueError("a message without its head")
        number, _, time, _ = struct.unpack("<HIQQ", fields)
        if number not in self.channels:
            return
        if time > MAX_STAMP_NS:
            raise ValueError("an impossible time")
        place = found.start - HEAD
        self._found.setdefault(number, array("q")).extend((time, chunk.start - HEAD if chunk else NO_CHUNK, place))


class Record(NamedTuple):
    """The position of a record's fields, in a file or a decompressed chunk."""

    kind: int
    start: int
    end: int


class Channel(NamedTuple):
    """A topic as sent by one publisher."""

    topic: str
    type: str
    cdr: bool


class Chunk(NamedTuple):
    """A chunk according to the index: counts of its messages and positions of their indexes, by channel."""

    start: int
    end: int
    indexes: dict[int, int]
    counts: dict[int, int]


class McapBytes:
    """Bounded reads of a file: never more bytes, or more memory, than it has; the file is not kept open."""

    def __init__(self, path: Path):
        self.path, self.size = path, path.stat().st_size

    def at(self, start: int, end: int) -> bytes:
        """Return the bytes from `start` to `end`; raises ValueError for a truncated file or an absurd size."""
        if not 0 <= start <= end <= self.size:
            raise ValueError("the file is cut off")
        if end - start > MAX_BYTES:
            raise ValueError("declares an absurd size")
        with self.path.open("rb") as file:
            file.seek(start)
            data = file.read(end - start)
        if len(data) != end - start:
            raise ValueError("the file is cut off")
        return data

    def record(self, start: int) -> Record:
        """Return the record at `start`; raises ValueError if the file ends inside it."""
        return record(self.at(start, min(start + HEAD, self.size)), start, self.size)

    def fields(self, found: Record, kind: int) -> Wire:
        """Return the fields of a record, which must be of this kind."""
        if found.kind != kind:
            raise ValueError("the index points to something else")
        return Wire(self.at(found.start, found.end), cdr=False)

    def chunk(self, found: Record) -> bytes:
        """Return the decompressed contents of a chunk; raises ValueError for a damaged one."""
        wire = self.fields(found, CHUNK)
        _, _, size = wire.numbers("Q", 3)
        checksum, packing = wire.number(), wire.text()
        data = wire.block(wire.number("Q"))
        if size > MAX_BYTES:
            raise ValueError("a chunk unpacks to an absurd size")
        inner = decompress(data, packing, size)
        if len(inner) != size or (checksum and zlib.crc32(inner) != checksum):
            raise ValueError("a chunk is damaged")
        return inner


def record(head: bytes, start: int, limit: int) -> Record:
    """Return the record that starts with `head` at `start`; raises ValueError if it does not end within `limit`."""
    if len(head) < HEAD:
        raise ValueError("the file is cut off")
    end = start + HEAD + int.from_bytes(head[1:HEAD], "little")
    if end > limit:
        raise ValueError("the file is cut off")
    if head[0] == 0:
        raise ValueError("a record is missing")
    return Record(head[0], start + HEAD, end)


def read_schema(wire: Wire) -> tuple[int, str]:
    """Return number and message type of a schema, as `sensor_msgs/Image`."""
    return wire.number("H"), one_line(wire.text()).replace("/msg/", "/")


def read_channel(wire: Wire, schemas: dict[int, str]) -> tuple[int, Channel | None]:
    """Return number and channel; None for an encoding that is not ROS's, ValueError for an unknown type."""
    number, schema = wire.numbers("H", 2)
    topic, encoding = one_line(wire.text()), wire.text()
    if schema and schema not in schemas:
        raise ValueError("the index is not complete")
    return number, Channel(topic, schemas[schema], ENCODINGS[encoding]) if schema and encoding in ENCODINGS else None


def read_chunk_index(wire: Wire) -> Chunk:
    """Return the positions of a chunk and of the indexes of its messages; raises ValueError for impossible ones."""
    _, _, start, length = wire.numbers("Q", 4)
    if length < MIN_CHUNK_BYTES:
        raise ValueError("the index is damaged")
    places = np.frombuffer(wire.data(), np.dtype([("channel", "<u2"), ("at", "<u8")]))
    end = start + length + wire.number("Q")
    indexes = dict(zip(places["channel"].tolist(), places["at"].tolist(), strict=True))
    inner = sorted(indexes.items(), key=lambda item: item[1])
    bounds = [at for _, at in inner] + [end]
    sizes = [after - at - INDEX_HEAD for at, after in pairwise(bounds)]
    if any(size < 0 for size in sizes) or bounds[0] < start + length:
        raise ValueError("the index is damaged")
    counts = {channel: size // ENTRY.itemsize for (channel, _), size in zip(inner, sizes, strict=True)}
    return Chunk(start, end, indexes, counts)


def read_message_index(wire: Wire, channel: int) -> NDArray[np.void]:
    """Return the (N,) times and positions within their chunk of a channel's messages."""
    if wire.number("H") != channel:
        raise ValueError("the index points to something else")
    return np.frombuffer(wire.data(), ENTRY)


def message_at(data: bytes, start: int) -> tuple[int, int, memoryview]:
    """Return channel, time and serialised data of the message at `start` of a decompressed chunk."""
    if start < 0:
        raise ValueError("the index points outside the chunk")
    found = record(data[start : start + HEAD], start, len(data))
    wire = Wire(memoryview(data)[found.start : found.end], cdr=False)
    if found.kind != MESSAGE:
        raise ValueError("the index points to something else")
    channel, _, time = wire.number("H"), wire.number(), wire.numbers("Q", 2)[0]
    return channel, time, wire.block(wire.left)


def _summary(file: McapBytes) -> tuple[int, bytes]:
    """Return start and records of the summary of a whole file; raises ValueError if missing."""
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
    """Yield the records of a chunk or summary; raises ValueError if they do not fill it."""
    at = 0
    while at < len(data):
        found = record(data[at : at + HEAD], at, len(data))
        yield found
        at = found.end
