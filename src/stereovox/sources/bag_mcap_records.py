# SPDX-License-Identifier: Apache-2.0
"""The records of an `.mcap` file (mcap.dev/spec): each is an opcode, a length and its fields, little-endian."""

from __future__ import annotations

import zlib
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.sources.bag_files import MAX_BYTES, one_line
from stereovox.sources.bag_messages import Wire
from stereovox.sources.bag_unpack import unpacked

START = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, STATISTICS = 2, 3, 4, 5, 6, 7, 8, 11
DATA_END = 15
HEAD = 9
"""Bytes before the fields of a record: opcode and length."""
MESSAGE_HEAD = 22
"""Bytes of a message before its data: channel, number, time of recording and of sending."""
INDEX_HEAD = HEAD + 6
"""Bytes of a message index before its entries, of 16 bytes each."""
SMALLEST = HEAD + 40
"""Bytes of an empty chunk."""
ENTRY = np.dtype([("time", "<u8"), ("offset", "<u8")])
ENCODINGS = {"cdr": True, "ros1": False}
"""How messages may be serialised, and whether that is ROS 2's way; others (JSON, protobuf) are none of ROS."""


class Record(NamedTuple):
    """Where a record's fields stand, in a file or in an unpacked chunk."""

    kind: int
    start: int
    end: int


class Channel(NamedTuple):
    """A topic as one publisher sends it."""

    topic: str
    type: str
    cdr: bool


class Chunk(NamedTuple):
    """A chunk by the index at the end of a file: counts and places of its messages' indexes, by channel."""

    start: int
    end: int
    indexes: dict[int, int]
    counts: dict[int, int]


class McapBytes:
    """A file that never gives out, and never makes room for, more bytes than it has; it is not kept open."""

    def __init__(self, path: Path):
        self.path, self.size = path, path.stat().st_size

    def at(self, start: int, end: int) -> bytes:
        """Return the bytes from `start` to `end`; raises ValueError where there are not so many, or absurdly many."""
        if not 0 <= start <= end <= self.size:
            raise ValueError("the file is cut off")
        if end - start > MAX_BYTES:
            raise ValueError("tells of an absurd size")
        with self.path.open("rb") as file:
            file.seek(start)
            data = file.read(end - start)
        if len(data) != end - start:
            raise ValueError("the file is cut off")
        return data

    def record(self, start: int) -> Record:
        """Return the record at `start`; raises ValueError where the file does not hold it to its end."""
        return record(self.at(start, min(start + HEAD, self.size)), start, self.size)

    def fields(self, found: Record, kind: int) -> Wire:
        """Return the fields of a record, which must be of this kind."""
        if found.kind != kind:
            raise ValueError("the index points to something else")
        return Wire(self.at(found.start, found.end), cdr=False)

    def chunk(self, found: Record) -> bytes:
        """Return the unpacked contents of a chunk; raises ValueError for a damaged one."""
        wire = self.fields(found, CHUNK)
        _, _, size = wire.numbers("Q", 3)
        checksum, packing = wire.number(), wire.text()
        data = wire.block(wire.number("Q"))
        if size > MAX_BYTES:
            raise ValueError("a chunk unpacks to an absurd size")
        inner = unpacked(data, packing, size)
        if len(inner) != size or (checksum and zlib.crc32(inner) != checksum):
            raise ValueError("a chunk is damaged")
        return inner


def record(head: bytes, start: int, limit: int) -> Record:
    """Return the record that starts with `head` at `start`; raises ValueError for none that ends within `limit`."""
    if len(head) < HEAD:
        raise ValueError("the file is cut off")
    end = start + HEAD + int.from_bytes(head[1:HEAD], "little")
    if end > limit:
        raise ValueError("the file is cut off")
    if head[0] == 0:
        raise ValueError("no record where one should be")
    return Record(head[0], start + HEAD, end)


def read_schema(wire: Wire) -> tuple[int, str]:
    """Return number and message type of a schema, as `sensor_msgs/Image`."""
    return wire.number("H"), one_line(wire.text()).replace("/msg/", "/")


def read_channel(wire: Wire, schemas: dict[int, str]) -> tuple[int, Channel | None]:
    """Return number and channel; None for one that is not serialised as ROS does, ValueError for an unknown type."""
    number, schema = wire.numbers("H", 2)
    topic, encoding = one_line(wire.text()), wire.text()
    if schema and schema not in schemas:
        raise ValueError("the index is not complete")
    return number, Channel(topic, schemas[schema], ENCODINGS[encoding]) if schema and encoding in ENCODINGS else None


def read_chunk_index(wire: Wire) -> Chunk:
    """Return where a chunk and the indexes of its messages stand; raises ValueError where that cannot be."""
    _, _, start, length = wire.numbers("Q", 4)
    if length < SMALLEST:
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
    """Return the (N,) times and places within their chunk of a channel's messages."""
    if wire.number("H") != channel:
        raise ValueError("the index points to something else")
    return np.frombuffer(wire.data(), ENTRY)


def message_at(data: bytes, start: int) -> tuple[int, int, memoryview]:
    """Return channel, time and serialised data of the message that stands at `start` in an unpacked chunk."""
    if start < 0:
        raise ValueError("the index points to nowhere")
    found = record(data[start : start + HEAD], start, len(data))
    wire = Wire(memoryview(data)[found.start : found.end], cdr=False)
    if found.kind != MESSAGE:
        raise ValueError("the index points to something else")
    channel, _, time = wire.number("H"), wire.number(), wire.numbers("Q", 2)[0]
    return channel, time, wire.block(wire.left)
