# SPDX-License-Identifier: Apache-2.0
"""Recordings in one `.mcap` file, by any message."""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, SourceError
from stereovox.sources.bag_files import MAX_BYTES, BagFile, one_line
from stereovox.sources.bag_mcap_index import LOOSE, Places, Scanned, Summary
from stereovox.sources.bag_mcap_records import McapBytes, message_at
from stereovox.sources.bag_messages import Wire
from stereovox.sources.bag_unpack import unzipped

CHUNKS = 4
"""Unpacked chunks kept: enough for an image, its camera and the poses around it."""


class McapFile(BagFile):
    """A recording of ROS 2, or of ROS 1 turned into `.mcap`: chunks not packed or with zstd or lz4.

    Read by the index at its end. Where that is missing, as after a recording that was cut off, or of no use, the file
    is gone through once when it is opened, and what is whole counts; `notes` then tell so.
    Raises SourceError, one line, for a file that holds nothing that can be read.
    """

    def __init__(self, path: Path):
        self.path = path
        self.notes = ()
        self._bytes = McapBytes(path)
        self._lock = threading.Lock()
        self._chunks: OrderedDict[int, bytes] = OrderedDict()
        self._places: dict[str, Places] = {}
        try:
            self._index: Summary | Scanned = Summary(self._bytes)
        except ValueError as error:
            self._index = self._scan(str(error))
        self.types = {channel.topic: channel.type for channel in self._index.channels.values()}

    def stamps(self, topic: str) -> NDArray[np.int64]:
        """Return the times at which the messages of `topic` were recorded; raises SourceError for a damaged file."""
        return self._of(topic)[:, 0]

    def read(self, topic: str, i: int) -> Wire:
        """Return message `i`; raises FrameRefused `unreadable` where the file is damaged."""
        try:
            with self._lock:
                time, chunk, start = self._of(topic)[i].tolist()
                number, recorded, data = self._message(chunk, start)
            channel = self._index.channels.get(number)
            if channel is None or channel.topic != topic or recorded != time:
                raise ValueError("the index points to something else")
            return Wire(unzipped(bytes(data), MAX_BYTES), cdr=channel.cdr)
        except (OSError, SourceError, ValueError, MemoryError) as error:
            raise FrameRefused("unreadable", f"{self.path}: message {i} of {topic}: {one_line(error)}") from None

    def _scan(self, why: str) -> Scanned:
        """Go through the file and note what was found."""
        found = Scanned(self._bytes)
        if not found.complete and not found.channels:
            raise SourceError(f"{self.path}: cut off or damaged before the first message; record or copy it again")
        rest = (
            ""
            if found.complete
            else f"; cut off or damaged at byte {found.whole} of {self._bytes.size}, the rest is lost"
        )
        lost = f"; {found.damaged} damaged chunks left out" if found.damaged else ""
        self.notes = (f"{self.path}: {one_line(why)}: gone through from the beginning{lost}{rest}",)
        return found

    def _of(self, topic: str) -> Places:
        """Return where the messages of a topic stand, in order of time."""
        if topic not in self._places:
            try:
                places = self._index.places(topic)
            except (OSError, ValueError) as error:
                cure = "repair it with 'mcap recover' or record it again"
                raise SourceError(f"{self.path}: topic {topic}: {one_line(error)}; {cure}") from None
            self._places[topic] = places[np.argsort(places[:, 0], kind="stable")]
        return self._places[topic]

    def _message(self, chunk: int, start: int) -> tuple[int, int, memoryview]:
        if chunk != LOOSE:
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
