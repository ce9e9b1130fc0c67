# SPDX-License-Identifier: Apache-2.0
"""ROS 2 recordings as rosbag2 folders with one or several `.mcap` or `.db3` files."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError
from stereovox.files.safe_io import read_bounded, yaml_value
from stereovox.sources.bags.files import BagFile, one_line
from stereovox.sources.bags.messages import Wire

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
