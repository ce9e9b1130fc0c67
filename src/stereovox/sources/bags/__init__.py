# SPDX-License-Identifier: Apache-2.0
"""ROS 1, ROS 2 and RealSense recordings, recognised by their first bytes."""

from __future__ import annotations

import os
from pathlib import Path

from stereovox.errors import SourceError
from stereovox.sources.bags.files import BagFile
from stereovox.sources.foreign_files import POINTS, is_pointer

MAGIC = {b"#ROSBAG V": ".bag", b"SQLite fo": ".db3", b"\x89MCAP0\r\n\1": ".mcap"}
FOLDER = "folder"
"""Result of `suffix_of` for a rosbag2 folder."""


def suffix_of(path: str) -> str:
    """Return `.bag`, `.db3` or `.mcap` for a file that is, or by its name should be, such a recording, else "".

    `FOLDER` for a rosbag2 folder. Never raises.
    """
    try:
        if os.path.isdir(path):
            from stereovox.sources.bags.files import is_bag_folder

            return FOLDER if is_bag_folder(path) else ""
        if not os.path.isfile(path):  # opening a named pipe would block
            return ""
        with open(path, "rb") as file:
            start = file.read(9)
    except (OSError, ValueError):
        return ""
    named = os.path.splitext(path)[1].lower()
    return MAGIC.get(start) or (named if named in MAGIC.values() else "")


def open_bag(path: Path) -> BagFile:
    """Open a `.bag`, `.db3`, `.mcap` or rosbag2 folder; raises SourceError for anything else or damage."""
    if path.is_dir():
        from stereovox.sources.bags.files import FolderFile

        return FolderFile(path, open_bag)
    try:
        with path.open("rb") as file:
            start = file.read(9)
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; make it readable") from None
    if not start:
        raise SourceError(f"{path}: the file is empty; record or copy it again")
    if is_pointer(path):
        raise SourceError(f"{path}: {POINTS}")
    if start not in MAGIC:
        what = "neither a ROS 1 bag (version 2.0) nor a .db3 or .mcap recording"
        raise SourceError(f"{path}: {what}, whatever its name says")
    if MAGIC[start] == ".bag":
        from stereovox.sources.bags.ros1 import Ros1File

        return Ros1File(path)
    if MAGIC[start] == ".mcap":
        from stereovox.sources.bags.mcap import McapFile

        return McapFile(path)
    from stereovox.sources.bags.files import Db3File

    return Db3File(path)
