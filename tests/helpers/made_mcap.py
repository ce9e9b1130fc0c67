# SPDX-License-Identifier: Apache-2.0
"""`.mcap` files for the tests, written record by record as mcap.dev/spec says, in every way that it allows.

Slow and obvious; rosbags' own writer cannot pack with lz4, leave the index out, or write messages outside of chunks.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import lz4.frame
from backports import zstd

MAGIC = b"\x89MCAP0\r\n"
PACKERS = {"": bytes, "brotli": bytes, "lz4": lz4.frame.compress, "zstd": zstd.compress}


@dataclass(frozen=True)
class Message:
    topic: str
    time: int
    data: bytes


@dataclass(frozen=True)
class Style:
    """How a file is written.

    packing: of chunks. chunk: messages in each, 0 for no chunks at all. crc: checksums. index, summary: whether there
    are message indexes and a summary; repeated: whether the summary repeats the channels; twice: whether it tells of
    every chunk twice. encoding: of the messages.
    """

    packing: str = ""
    chunk: int = 3
    crc: bool = False
    index: bool = True
    summary: bool = True
    repeated: bool = True
    twice: bool = False
    encoding: str = "cdr"
    profile: str = "ros2"


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def record(kind: int, fields: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(fields)) + fields


def schema(number: int, name: str) -> bytes:
    return record(3, struct.pack("<H", number) + text(name) + text("ros2msg") + text("# not told"))


def channel(number: int, schema_number: int, topic: str, encoding: str) -> bytes:
    metadata = text("offered_qos_profiles") + text("")
    fields = struct.pack("<HH", number, schema_number) + text(topic) + text(encoding)
    return record(4, fields + struct.pack("<I", len(metadata)) + metadata)


def message(number: int, sequence: int, said: Message) -> bytes:
    return record(5, struct.pack("<HIQQ", number, sequence, said.time, said.time + 1) + said.data)


def chunk_record(inner: bytes, start: int, end: int, style: Style) -> bytes:
    packed = PACKERS[style.packing](inner)
    crc = zlib.crc32(inner) if style.crc else 0
    head = struct.pack("<QQQI", start, end, len(inner), crc)
    return record(6, head + text(style.packing) + struct.pack("<Q", len(packed)) + packed)


def mcap(path: Path, types: dict[str, str], messages: list[Message], style: Style = Style()) -> Path:
    """Write `messages` in this order; types: of each topic, as `std_msgs/msg/String`."""
    numbers = {topic: k + 1 for k, topic in enumerate(types)}
    told = b"".join(schema(k, types[topic]) + channel(k, k, topic, style.encoding) for topic, k in numbers.items())
    data, chunk_indexes, chunks = MAGIC + record(1, text(style.profile) + text("made for tests")), b"", 0
    if not style.chunk:
        data += told + b"".join(message(numbers[said.topic], k, said) for k, said in enumerate(messages))
    for at in range(0, len(messages), style.chunk) if style.chunk else ():
        part, inner, places = messages[at : at + style.chunk], told if at == 0 else b"", {}
        for k, said in enumerate(part):
            places.setdefault(numbers[said.topic], []).append((said.time, len(inner)))
            inner += message(numbers[said.topic], at + k, said)
        start, end = min(said.time for said in part), max(said.time for said in part)
        packed = chunk_record(inner, start, end, style)
        chunk_start, indexes, offsets = len(data), b"", b""
        for number, entries in places.items() if style.index else ():
            offsets += struct.pack("<HQ", number, chunk_start + len(packed) + len(indexes))
            body = b"".join(struct.pack("<QQ", *entry) for entry in entries)
            indexes += record(7, struct.pack("<HI", number, len(body)) + body)
        data += packed + indexes
        fields = struct.pack("<QQQQ", start, end, chunk_start, len(packed))
        fields += struct.pack("<I", len(offsets)) + offsets + struct.pack("<Q", len(indexes)) + text(style.packing)
        chunk_indexes += record(8, fields + struct.pack("<QQ", len(PACKERS[style.packing](inner)), len(inner)))
        chunks += 1
    data += record(15, struct.pack("<I", 0))
    summary_start = len(data) if style.summary else 0
    times_told = 2 if style.twice else 1
    summary = (told if style.repeated else b"") + chunk_indexes * times_told
    times = [said.time for said in messages] or [0]
    summary += record(
        11,
        struct.pack(
            "<QHIIIIQQI", len(messages) * times_told, len(types), len(types), 0, 0, chunks, min(times), max(times), 0
        ),
    )
    summary = summary if style.summary else b""
    footer = struct.pack("<BQQQ", 2, 20, summary_start, 0)
    crc = zlib.crc32(summary + footer) if style.crc and style.summary else 0
    path.write_bytes(data + summary + footer + struct.pack("<I", crc) + MAGIC)
    return path
