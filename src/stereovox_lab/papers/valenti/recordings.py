# SPDX-License-Identifier: Apache-2.0
"""Find recordings below a folder: sequences of KITTI tracking, and drives of KITTI raw data."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import SourceError
from stereovox.frame import StereoFrame
from stereovox.opening import open_source
from stereovox.sources.kitti.raw import KittiRaw
from stereovox.sources.kitti.tracking import LEFT, SEQUENCE, KittiTracking
from stereovox.sources.lidar import LidarSource


class Drive(LidarSource, Protocol):
    """A recording of stereo pairs with lidar scans. camera: the rectified left one of all frames."""

    camera: PinholeCamera

    def frame(self, i: int) -> StereoFrame:
        """Return the images of frame `i`; never fails for bad files: the frame then has a `fault`."""
        ...


def find_drives(data: str | Path) -> list[Drive]:
    """Return all recordings at or below the folder `data` that have a lidar, in the order of their paths.

    data: a drive of KITTI raw data, a sequence of KITTI tracking (`training/image_02/0000`), or any folder above them.
    Raises SourceError, one line: no such folder, no recording in it, an unusable one, none with lidar.
    """
    if not os.path.isdir(data):
        raise SourceError(f"{data}: no such folder; give a drive of KITTI raw data or a folder with training/image_02")
    sources = [open_source(place) for place in _places(Path(data))]
    if not sources:
        raise SourceError(f"{data}: holds no drive of KITTI raw data and no sequence training/image_02/0000; give one")
    found = [source for source in sources if isinstance(source, LidarSource) and source.has_lidar]
    if not found:
        raise SourceError(f"{data}: no recording in it has lidar scans, which are the truth here; add its velodyne")
    return found  # pyrefly: ignore[bad-return] - both layouts deliver stereo frames


def _places(folder: Path) -> Iterator[Path]:
    """Yield the recordings at or below `folder`; a recording contains no other."""
    where = os.fspath(folder)
    if KittiTracking.recognises(where):
        if folder.resolve().parent.name == LEFT:
            yield folder
        else:
            yield from sorted(one for one in (folder / LEFT).iterdir() if SEQUENCE.fullmatch(one.name))
    elif KittiRaw.recognises(where):
        yield folder
    else:
        for name in sorted(entry.name for entry in os.scandir(folder) if entry.is_dir(follow_symlinks=False)):
            yield from _places(folder / name)
