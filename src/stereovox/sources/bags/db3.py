# SPDX-License-Identifier: Apache-2.0
"""ROS 2 recordings in one SQLite file."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, SourceError
from stereovox.sources.bags.files import MAX_BYTES, BagFile, one_line
from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.unpack import decompress_message
from stereovox.sources.sqlite_file import SqliteFile


class Db3File(BagFile):
    """A ROS 2 recording in one SQLite file, as written by realsense-viewer and pyrealsense2 2.57 and later.

    Read with Python's own sqlite3: neither ROS nor pyrealsense2 is needed.
    """

    def __init__(self, path: Path):
        self.path = path
        try:
            self._file = SqliteFile(path, ("topics", "messages"), MAX_BYTES)
            rows = self._file.rows("SELECT id, name, type FROM topics WHERE id IS NOT NULL")
            used = {row[0] for row in self._file.rows("SELECT DISTINCT topic_id FROM messages")}
        except (sqlite3.Error, MemoryError, ValueError) as error:  # ValueError: messages that are not text
            raise SourceError(
                f"{path}: {one_line(error)}; not a .db3 recording, or damaged: record or copy it again"
            ) from None
        known = [(key, one_line(name), one_line(kind).replace("/msg/", "/")) for key, name, kind in rows if key in used]
        self._keys = {name: key for key, name, _ in known}
        self.types = {name: kind for _, name, kind in known}
        self._ids: dict[str, tuple[NDArray[np.int64], NDArray[np.int64]]] = {}

    def stamps(self, topic: str) -> NDArray[np.int64]:
        """Return the times at which the messages of `topic` were recorded; raises SourceError for a damaged file."""
        return self._index(topic)[0]

    def read(self, topic: str, i: int) -> Wire:
        """Return message `i`; raises FrameRefused `unreadable` if the file is damaged."""
        try:
            key = int(self._index(topic)[1][i])
            rows = self._file.rows("SELECT data FROM messages WHERE id = ?", key)
            if len(rows) != 1 or not isinstance(rows[0][0], bytes):
                raise ValueError("has no message")
            return Wire(decompress_message(rows[0][0], MAX_BYTES), cdr=True)
        except (sqlite3.Error, SourceError, ValueError, OverflowError, MemoryError) as error:
            raise FrameRefused("unreadable", f"{self.path}: message {i} of {topic}: {one_line(error)}") from None

    def _index(self, topic: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return times and row numbers of a topic's messages."""
        if topic not in self._ids:
            query = "SELECT timestamp, id FROM messages WHERE topic_id = ? ORDER BY timestamp, id"
            try:
                rows = np.array(self._file.rows(query, self._keys[topic]), np.int64)
            except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
                raise SourceError(f"{self.path}: topic {topic}: {one_line(error)}; record or copy it again") from None
            self._ids[topic] = rows[:, 0], rows[:, 1]
        return self._ids[topic]
