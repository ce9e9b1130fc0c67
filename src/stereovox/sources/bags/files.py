# SPDX-License-Identifier: Apache-2.0
"""The protocol of recordings of ROS messages: `.bag` (ROS 1), `.db3` and `.mcap` (ROS 2), and rosbag2 folders.

Every message of every topic can be read by its number. Any damage gives a one-line error, and no allocation trusts a
size that the file declares: reads are bounded by the size of the file, decompression by `MAX_BYTES`. Written by hand,
because in the usual readers a hostile file determines the size of buffers.

Bounded decompression of recordings, by chunk or by message. ROS 2 recordings in one SQLite file. ROS 2 recordings as
rosbag2 folders with one or several `.mcap` or `.db3` files.
"""

from __future__ import annotations

import os
import re
import sqlite3
import sys
from collections.abc import Callable
from glob import escape, glob
from pathlib import Path, PurePath
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, MissingExtra, SourceError
from stereovox.files.safe_io import read_bounded, yaml_value
from stereovox.sources.bags.messages import Wire
from stereovox.sources.sqlite_file import SqliteFile

MAX_BYTES = 256 * 1024 * 1024
"""Largest message or chunk after decompression; anything larger is treated as damaged."""
UNFINISHED = ".unfinished"
"""Ending of a folder with a growing recording; after a kill, its contents can be read from an `.mcap`."""


class BagFile(Protocol):
    """Recorded messages by topic and number, in order of their recording time.

    Attributes:
        path: The file or folder.
        types: Message type of each topic that has messages, as `sensor_msgs/Image`.
        notes: Defects of a file that is still readable, one line each.
    """

    path: Path
    types: dict[str, str]
    notes: tuple[str, ...] = ()

    def stamps(self, topic: str) -> NDArray[np.int64]:
        """Return when the messages of a topic were recorded.

        Args:
            topic: A topic of `types`.

        Returns:
            (N,) int64 nanoseconds, ascending.

        Raises:
            SourceError: The file is damaged.
        """
        ...

    def read(self, topic: str, i: int) -> Wire:
        """Read one message.

        Args:
            topic: A topic of `types`.
            i: Number of the message, in the order of `stamps`.

        Returns:
            The serialised message.

        Raises:
            FrameRefused: `unreadable`, if the file is damaged.
        """
        ...


def one_line(error: object) -> str:
    """Return the text of an error or name on one line, without a full stop."""
    plain = re.sub(r"\('(.*?)',?\)", r"\1", str(error))  # some print an exception's arguments as a tuple
    return " ".join(plain.split()).rstrip(".") or f"damaged ({type(error).__name__})"


def cut_off(path: str) -> str:
    """Return the file that a killed recorder left, empty if missing."""
    pattern = f"{escape(path)}.*{UNFINISHED}/*/{escape(os.path.basename(path))}"
    return max(glob(pattern), default="", key=os.path.getmtime)


STEP = 4 * 1024 * 1024
MAX_RATIO = 1000
"""Largest ratio of decompressed to compressed bytes: recordings of real scenes never reach it."""
ALWAYS_ALLOWED = 32 * 1024 * 1024
"""Decompressed bytes that are always accepted: an empty image compresses to almost nothing."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""Magic of a zstd frame; no serialised ROS message starts with it."""


def max_unpacked(packed: int) -> int:
    """Return the largest decompressed size accepted for this many compressed bytes; more counts as an attack."""
    return max(ALWAYS_ALLOWED, MAX_RATIO * packed)


def decompress(data: bytes | memoryview, compression: str, limit: int) -> bytes:
    """Return decompressed bytes; compression: `bz2`, `lz4`, `zstd`, or "" and `none` for none.

    Raises ValueError for data that is damaged, truncated, in another format, or exceeds `limit` or `max_unpacked`,
    and MissingExtra if its library is not installed.
    """
    if compression in ("", "none"):
        return bytes(data)
    limit = min(limit, max_unpacked(len(data)))
    if compression == "zstd" and _declared_size(data) > limit:
        raise ValueError("declares an absurd size")
    parts, size, rest = [], 0, bytes(data)
    while rest and size <= limit:  # there may be several packed pieces
        unpacking = _decompressor(compression)
        while not unpacking.eof and size <= limit:  # in steps: lz4 allocates all of `max_length` at once
            parts.append(_step(unpacking, rest))
            rest = b""
            size += len(parts[-1])
            if unpacking.needs_input and not unpacking.eof:
                raise ValueError("a packed part is cut off")
        rest = unpacking.unused_data if unpacking.eof else b""
    if size > limit:
        raise ValueError("a chunk unpacks to an absurd size")
    return b"".join(parts)


def decompress_message(data: bytes, limit: int) -> bytes:
    """Return a message, decompressed if it was compressed by itself: rosbag2's mode `message`, and librealsense 2.57.

    Raises as `decompress`.
    """
    return decompress(data, "zstd", limit) if data[:4] == ZSTD else data


def _declared_size(data: bytes | memoryview) -> int:
    zstd = _zstd()
    try:
        return zstd.get_frame_info(bytes(data[:32])).decompressed_size or 0  # it may be missing
    except zstd.ZstdError as error:
        raise ValueError(f"cannot be unpacked: {error}") from None


def _step(unpacking: Any, data: bytes) -> bytes:
    try:
        return unpacking.decompress(data, max_length=STEP)
    except Exception as error:  # bz2, lz4 and zstd each have their own
        raise ValueError(f"cannot be unpacked: {error}") from None


def _decompressor(compression: str) -> Any:
    if compression == "bz2":
        import bz2

        return bz2.BZ2Decompressor()
    if compression == "lz4":
        return _lz4().LZ4FrameDecompressor()
    if compression == "zstd":
        return _zstd().ZstdDecompressor()
    raise ValueError(f"packed with '{compression[:20]}', which is unknown")


def _lz4() -> Any:
    try:
        import lz4.frame
    except ImportError:
        raise MissingExtra("lz4", "bags") from None
    return lz4.frame


def _zstd() -> Any:
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd  # comes with rosbags
    except ImportError:
        raise MissingExtra("zstd", "bags") from None
    return zstd


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


METADATA, TITLE = "metadata.yaml", "rosbag2_bagfile_information"
MAX_METADATA = 1024 * 1024
"""Bytes of a metadata file; larger ones count as damaged."""
NUMBERED = re.compile(r".*_(\d+)\.(mcap|db3)", re.DOTALL)


class FolderFile(BagFile):
    """A rosbag2 folder; the parts of a split recording are joined, whatever their names.

    Without `metadata.yaml`, which rosbag2 writes at the end, the numbered files of the folder are used, with a
    note. open_part: opens one of the files. Raises SourceError for files that are missing, damaged, or compressed as a
    whole and not readable.
    """

    def __init__(self, path: Path, open_part: Callable[[Path], BagFile]):
        self.path = path
        names, notes = _files(path)
        self._parts: list[BagFile] = [open_part(_whole(path, name)) for name in names]
        self.types = {topic: kind for part in self._parts for topic, kind in part.types.items()}
        self.notes = (*notes, *(note for part in self._parts for note in part.notes))
        self._places: dict[str, NDArray[np.int64]] = {}

    def stamps(self, topic: str) -> NDArray[np.int64]:
        """Return the times at which the messages of `topic` were recorded; raises SourceError for a damaged file."""
        return self._of(topic)[:, 0]

    def read(self, topic: str, i: int) -> Wire:
        """Return message `i`; raises FrameRefused `unreadable` if its file is damaged."""
        _, part, k = self._of(topic)[i].tolist()
        return self._parts[part].read(topic, k)

    def _of(self, topic: str) -> NDArray[np.int64]:
        """Return time, file number and message number of a topic's messages, (N, 3), in time order."""
        if topic not in self._places:
            rows = []
            for number, part in enumerate(self._parts):
                if topic in part.types:
                    stamps = part.stamps(topic)
                    rows.append(np.stack([stamps, np.full_like(stamps, number), np.arange(len(stamps))], axis=1))
            places = np.concatenate(rows)
            self._places[topic] = places[np.argsort(places[:, 0], kind="stable")]
        return self._places[topic]


def is_bag_folder(path: str) -> bool:
    """Return whether a folder is a rosbag2 recording. Never raises."""
    folder = Path(path)
    try:
        if not folder.is_dir():
            return False
        if (folder / METADATA).is_file():
            with (folder / METADATA).open("rb") as file:
                return TITLE.encode() in file.read(4096)
        return bool(_numbered(folder))
    except (OSError, ValueError):
        return False


def _files(folder: Path) -> tuple[list[str], tuple[str, ...]]:
    """Return the names of a folder's files in order, and notes."""
    if not (folder / METADATA).is_file():
        names = _numbered(folder)
        if not names:
            raise SourceError(f"{folder}: no {METADATA} in it; give the folder that rosbag2 made, or a file of it")
        return names, (f"{folder}: no {METADATA}, as after an interrupted recording: using {_few(names)}",)
    metadata = _metadata(folder / METADATA)
    names = metadata.get("relative_file_paths")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        raise SourceError(f"{folder / METADATA}: names no files; write it again with 'ros2 bag reindex'")
    return list(dict.fromkeys(PurePath(name).name for name in names)), ()  # older versions include the folder


def _metadata(path: Path) -> dict[str, Any]:
    try:
        metadata = yaml_value(read_bounded(path, MAX_METADATA))[TITLE]
        if not isinstance(metadata, dict):
            raise TypeError(f"{TITLE} is empty")
    except (OSError, ValueError, TypeError, KeyError) as error:
        cure = "write it again with 'ros2 bag reindex'"
        raise SourceError(f"{path}: {one_line(error)[:200]}; {cure}") from None
    return metadata


def _numbered(folder: Path) -> list[str]:
    """Return the files called `<anything>_<number>.mcap` or `.db3`, by number, if all share one name."""
    found = {}
    for path in folder.iterdir():
        match = NUMBERED.fullmatch(path.name)
        if match and path.is_file():
            found[path.name] = int(match[1]) if len(match[1]) < 10 else 0
    same = len({name.rpartition("_")[0] for name in found}) == 1
    return sorted(found, key=lambda name: found[name]) if same else []


def _whole(folder: Path, name: str) -> Path:
    """Return a file of the folder, unpacked if it was packed as a whole; raises SourceError if it is missing."""
    path = folder / name
    if path.suffix == ".zstd":
        if not os.path.isfile(path.with_suffix("")):
            raise SourceError(
                f"{path}: packed as a whole; unpack it with: zstd -d '{path}' -o '{path.with_suffix('')}'"
            )
        return path.with_suffix("")
    if not os.path.isfile(path):  # Path.is_file may raise
        raise SourceError(
            f"{path}: is missing; copy the whole folder, or write {METADATA} again with 'ros2 bag reindex'"
        )
    return path


def _few(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
