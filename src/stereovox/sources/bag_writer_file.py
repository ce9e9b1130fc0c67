# SPDX-License-Identifier: Apache-2.0
"""Where a `BagWriter` puts its messages: a ROS 1 bag, a `.db3` or `.mcap` file or a rosbag2 folder, all or nothing."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from stereovox.errors import MissingExtra, SourceError
from stereovox.files import sync_file, sync_folder, sync_tree
from stereovox.sources.bag_files import one_line

SECONDS = {1: 2**32, 2: 2**31}
"""Seconds that a time of ROS 1 (uint32) and of ROS 2 (int32) can count."""
TF_MESSAGE, OCTOMAP = "tf2_msgs/msg/TFMessage", "octomap_msgs/msg/Octomap"
NOT_IN_ROSBAGS = {
    TF_MESSAGE: "geometry_msgs/TransformStamped[] transforms\n",
    OCTOMAP: "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n",
}
"""Definitions of messages that rosbags' types of a ROS may lack."""
VERSION = 8
"""Of rosbag2's metadata: the newest that every distribution since Humble reads."""


class BagFileWriter:
    """Serialises messages and writes them beside `path`; `finish` moves the whole recording there.

    ros: 1 for a path that ends in `.bag`, else 2. store: rosbags' types of that ROS. packed: chunks of a `.bag` are
    packed with lz4, those of an `.mcap` and of a folder with zstd; `.db3` has no such thing.
    Raises MissingExtra without rosbags, SourceError, one line, where the recording cannot be written.
    """

    def __init__(self, path: Path, packed: bool = True):
        self.path = path
        self._packed = packed
        self._ending = path.suffix.lower()
        self.ros = 1 if self._ending == ".bag" else 2
        self.store = typestore(self.ros)
        self._connections: dict[str, Any] = {}
        self._writer: Any = None
        self._target = Path(os.path.realpath(path))  # a link keeps pointing to where it pointed
        self._folder = self._target.with_name(f".{uuid.uuid4().hex[:12]}.new")
        self._check()

    def open(self) -> None:
        """Begin; nothing is at `path` yet."""
        try:
            with self._told():
                self._folder.mkdir()
                self._writer = self._ros1() if self.ros == 1 else self._ros2()
                self._writer.open()
        except SourceError:
            self.abort()
            raise

    def write(self, topic: str, kind: str, stamp_ns: int, message: Any, latched: bool = False) -> None:
        """Write one message of the store's type `kind` (`nav_msgs/msg/Odometry`), recorded at `stamp_ns`.

        latched: whoever comes later is to see the last one of the topic.
        """
        if self._writer is None:
            raise SourceError(f"{self.path}: not open; write 'with BagWriter(path) as bag:'")
        self.check_stamp(stamp_ns)
        with self._told():
            if topic not in self._connections:
                self._connections[topic] = self._connect(topic, kind, latched)
            if (held := self._connections[topic].msgtype) != kind:
                raise SourceError(f"{self.path}: {topic} holds {held}, no {kind}; give each its own topic")
            pack = self.store.serialize_ros1 if self.ros == 1 else self.store.serialize_cdr
            self._writer.write(self._connections[topic], int(stamp_ns), pack(message, kind))

    def check_stamp(self, stamp_ns: int) -> None:
        """Raise SourceError for a time that ROS cannot write down."""
        if not 0 <= stamp_ns < SECONDS[self.ros] * 1_000_000_000:
            limit = f"0 and {SECONDS[self.ros]} seconds"
            raise SourceError(f"{self.path}: the time {stamp_ns} ns must lie between {limit}; shift the clock")

    def finish(self) -> None:
        """Complete the recording and put it where it belongs; an older file of that name is replaced."""
        try:
            with self._told():
                self._writer.close()
                self._move()
        finally:
            self.abort()

    def abort(self) -> None:
        """Give up: nothing is left, and an older file stays as it was."""
        if self._writer is not None:
            with suppress(Exception):
                self._writer.abort()
            self._writer = None
        shutil.rmtree(self._folder, ignore_errors=True)

    def _check(self) -> None:
        """Refuse a place that cannot hold the recording, before anything is written."""
        file = self._ending in (".bag", ".db3", ".mcap")
        if file and self._target.is_dir():
            raise SourceError(f"{self.path}: is a folder; name a file")
        if not file and self._target.exists() and (not self._target.is_dir() or any(self._target.iterdir())):
            raise SourceError(
                f"{self.path}: is there and not empty; give a new folder, or a name ending in .bag or .mcap"
            )
        if self._ending == ".db3" and set(str(self._target)) & set("?#%"):
            raise SourceError(f"{self.path}: SQLite's library takes ?, # and % in a name amiss; choose another name")

    def _ros1(self) -> Any:
        from rosbags.rosbag1 import Writer

        writer = Writer(self._folder / self._target.name)
        if self._packed:
            writer.set_compression(Writer.CompressionFormat.LZ4)
        return writer

    def _ros2(self) -> Any:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        sqlite = self._ending == ".db3"
        # rosbags calls the file inside like its folder, and says so in the metadata
        name = self._target.stem if self._ending in (".db3", ".mcap") else self._target.name
        plugin = StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP
        writer = Writer(self._folder / name, version=VERSION, storage_plugin=plugin)
        if self._packed and not sqlite:
            writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        return writer

    def _connect(self, topic: str, kind: str, latched: bool) -> Any:
        if self.ros == 1:
            more: dict[str, Any] = {"callerid": "/stereovox", "latching": int(latched)}
        else:
            more = {"offered_qos_profiles": [_transient_local()] if latched else []}
        return self._writer.add_connection(topic, kind, typestore=self.store, **more)

    def _move(self) -> None:
        made: Path = self._writer.path
        if self._ending in (".db3", ".mcap"):
            made = made / f"{made.name}{self._ending}"
        if made.is_dir():
            sync_tree(made)
        else:
            sync_file(made)
        made.replace(self._target)
        sync_folder(self._target.parent)

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Turn what goes wrong while writing into one line."""
        try:
            yield
        except OSError as error:
            reason = one_line(error.strerror or error)
            cure = "choose a folder that exists, has room and can be written"
            raise SourceError(f"{self.path}: cannot be written ({reason}); {cure}") from None
        except SourceError:
            raise
        except Exception as error:  # rosbags, SQLite and struct each have their own
            raise SourceError(f"{self.path}: cannot be written ({one_line(error)})") from None


def typestore(ros: int) -> Any:
    """Return rosbags' message types of ROS 1 or 2; raises MissingExtra without rosbags."""
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError:
        raise MissingExtra("rosbags", "bags") from None
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    for kind, definition in NOT_IN_ROSBAGS.items():
        if kind not in store.types:
            store.register(get_types_from_msg(definition, kind))
    return store


def _transient_local() -> Any:
    """Return ROS 2's word for latched: reliable, the last message kept for who comes later."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(0, 0)
    kept = QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL
    return Qos(*kept, never, never, QosLiveliness.SYSTEM_DEFAULT, never, False)
