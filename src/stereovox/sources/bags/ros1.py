# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags: rosbags reads the index; bounded reads and bounded decompression make damage harmless."""

from __future__ import annotations

import io
import os
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, MissingExtra, SourceError
from stereovox.sources.bags.files import MAX_BYTES, BagFile, decompress, one_line
from stereovox.sources.bags.messages import Wire

CHUNKS = 4
"""Decompressed chunks kept: enough for an image, its metadata and the poses around it."""


class Ros1File(BagFile):
    """A ROS 1 bag of version 2.0, uncompressed or with bz2 or lz4; rosbags reads its index."""

    def __init__(self, path: Path):
        try:
            from rosbags.rosbag1 import Reader
        except ImportError:
            raise MissingExtra("rosbags", "bags") from None
        self.path = path
        self._reader = Reader(cast(Any, _Bounded(path)))
        try:
            self._reader.open()
        except Exception as error:  # rosbags reports damage by a dozen kinds of exceptions, including assertions
            raise SourceError(
                f"{path}: {one_line(error)}; repair it with 'rosbag reindex' or record it again"
            ) from None
        self._entries: dict[str, list[Any]] = {}
        self.types = {}
        for connection in self._reader.connections:
            topic = one_line(connection.topic)
            self._entries.setdefault(topic, []).extend(self._reader.indexes[connection.id])
            self.types[topic] = one_line(connection.msgtype).replace("/msg/", "/")
        for topic, entries in list(self._entries.items()):
            entries.sort()  # by time only, and stable
            if not entries:
                del self._entries[topic], self.types[topic]
        self._chunks: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()

    def stamps(self, topic: str) -> NDArray[np.int64]:
        """Return the times at which the messages of `topic` were recorded."""
        return np.array([entry.time for entry in self._entries[topic]], np.int64)

    def read(self, topic: str, i: int) -> Wire:
        """Return message `i`; raises FrameRefused `unreadable` if the bag is damaged."""
        entry = self._entries[topic][i]
        try:
            with self._lock:
                return Wire(self._message(entry), cdr=False)
        except Exception as error:  # as above, and exceptions of bz2 and lz4
            raise FrameRefused("unreadable", f"{self.path}: message {i} of {topic}: {one_line(error)}") from None

    def _message(self, entry: Any) -> bytes:
        from rosbags.rosbag1.reader import Header, RecordType, read_bytes, read_uint32

        chunk = io.BytesIO(self._chunk(entry.chunk_pos))
        chunk.seek(entry.offset)
        while (kind := (header := Header.read(chunk)).get_uint8("op")) == RecordType.CONNECTION:
            chunk.seek(read_uint32(chunk), os.SEEK_CUR)
        if kind != RecordType.MSGDATA or header.get_time("time") != entry.time:
            raise ValueError("the index points to something else")
        return read_bytes(chunk, read_uint32(chunk))

    def _chunk(self, position: int) -> bytes:
        if position not in self._chunks:
            chunk, file = self._reader.chunks[position], cast(Any, self._reader.bio)
            file.seek(chunk.datapos)
            data = file.read(chunk.datasize)
            if len(data) != chunk.datasize:
                raise ValueError("the file is cut off")
            self._chunks[position] = _unpacked(data, chunk.decompressor)
            while len(self._chunks) > CHUNKS:
                self._chunks.popitem(last=False)
        self._chunks.move_to_end(position)
        return self._chunks[position]


class _Bounded:
    """A path whose file never reads, or allocates memory for, more bytes than it has left."""

    def __init__(self, path: Path):
        self._path = path

    def exists(self) -> bool:
        return self._path.exists()

    def open(self, mode: str) -> _BoundedFile:
        return _BoundedFile(self._path.open("rb"), self._path.stat().st_size)

    def __str__(self) -> str:
        return str(self._path)


class _BoundedFile:
    def __init__(self, file: io.BufferedReader, size: int):
        self._file, self._size = file, size
        self.readline, self.seek, self.tell, self.close = file.readline, file.seek, file.tell, file.close

    def read(self, size: int) -> bytes:
        return self._file.read(min(size, max(self._size - self._file.tell(), 0), MAX_BYTES))


def _unpacked(data: bytes, decompressor: Any) -> bytes:
    """Return the contents of a chunk; raises ValueError if it is damaged or expands beyond `MAX_BYTES`."""
    from rosbags.rosbag1.reader import decompressors

    packing = next((name for name in ("bz2", "lz4") if decompressors[name] is decompressor), "")
    return decompress(data, packing, MAX_BYTES)
