# SPDX-License-Identifier: Apache-2.0
"""The kinds of files that hold recorded ROS messages: `.bag` (ROS 1), `.db3` and `.mcap` (ROS 2), and rosbag2 folders.

All give any message of any topic by its number. Whatever is wrong with a file ends in one line, and nothing is
allocated because a damaged file says so: reads are bounded by the size of the file, unpacking by `MAX_BYTES`.
By hand, because in the usual readers a hostile file sizes the buffers.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError
from stereovox.sources.bag_messages import Wire

MAX_BYTES = 256 * 1024 * 1024
"""A message or chunk that unpacks to more than this is taken for damaged."""
MAGIC = {b"#ROSBAG V": ".bag", b"SQLite fo": ".db3", b"\x89MCAP0\r\n\1": ".mcap"}
FOLDER = "folder"
"""What `suffix_of` calls a folder of rosbag2."""


class BagFile(Protocol):
    """Recorded messages by topic and number, in order of the time at which they were recorded.

    types: message type of every topic that has messages, as `sensor_msgs/Image`.
    notes: what is wrong with the file though it can be read, one line each.
    """

    path: Path
    types: dict[str, str]
    notes: tuple[str, ...] = ()

    def stamps(self, topic: str) -> NDArray[np.int64]:
        """Return the (N,) times in nanoseconds at which the messages of `topic` were recorded, in order."""
        ...

    def read(self, topic: str, i: int) -> Wire:
        """Return message `i`; raises FrameRefused `unreadable` where the file is damaged."""
        ...


def suffix_of(path: str) -> str:
    """Return `.bag`, `.db3` or `.mcap` for a file that is, or by its name should be, such a recording, else "".

    `FOLDER` for a folder that rosbag2 made. Never raises.
    """
    try:
        if os.path.isdir(path):
            from stereovox.sources.bag_folder import is_bag_folder

            return FOLDER if is_bag_folder(path) else ""
        if not os.path.isfile(path):  # a named pipe would be waited for
            return ""
        with open(path, "rb") as file:
            start = file.read(9)
    except (OSError, ValueError):
        return ""
    named = os.path.splitext(path)[1].lower()
    return MAGIC.get(start) or (named if named in MAGIC.values() else "")


def open_bag(path: Path) -> BagFile:
    """Open a `.bag`, `.db3`, `.mcap` or rosbag2 folder; raises SourceError, one line, for anything else or damage."""
    if path.is_dir():
        from stereovox.sources.bag_folder import FolderFile

        return FolderFile(path)
    try:
        with path.open("rb") as file:
            start = file.read(9)
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; make it readable") from None
    if not start:
        raise SourceError(f"{path}: the file is empty; record or copy it again")
    if start not in MAGIC:
        what = "neither a ROS 1 bag (version 2.0) nor a .db3 or .mcap recording"
        raise SourceError(f"{path}: {what}, whatever its name says")
    if MAGIC[start] == ".bag":
        from stereovox.sources.bag_ros1 import Ros1File

        return Ros1File(path)
    if MAGIC[start] == ".mcap":
        from stereovox.sources.bag_mcap import McapFile

        return McapFile(path)
    from stereovox.sources.bag_db3 import Db3File

    return Db3File(path)


def one_line(said: object) -> str:
    """Return the text of an error or name in one line, without a full stop."""
    plain = re.sub(r"\('(.*?)',?\)", r"\1", str(said))  # some print the arguments of an exception as they are
    return " ".join(plain.split()).rstrip(".") or f"damaged ({type(said).__name__})"
