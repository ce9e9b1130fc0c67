# SPDX-License-Identifier: Apache-2.0
"""Sequences of KITTI's odometry benchmark."""

from __future__ import annotations

import os
import re
from pathlib import Path

from stereovox.errors import SourceError
from stereovox.sources.kitti.base import (
    PAIRS,
    KittiSource,
    choose_pair,
    folder_of,
    location,
    named_file,
    numbers_in,
    time_lines,
)
from stereovox.sources.kitti.calibration import KittiCalibration, read_calibration
from stereovox.sources.kitti.poses import read_pose_file
from stereovox.sources.trajectory import ns_from_seconds

IMAGE = re.compile(r"(\d{6})\.png")
CALIBRATION, TIMES = "calib.txt", "times.txt"


class KittiOdometry(KittiSource):
    """A folder `sequences/00` with image_0 and image_1 (grey) or image_2 and image_3 (colour), calib.txt, times.txt.

    where: the folder, or with parameters `sequences/00?camera=colour&poses=FILE`:
        camera: `grey` or `colour`; without it grey where there are such images.
        poses: a file of 3x4 matrices T_world_cam0 line by line; without it `poses/00.txt` beside `sequences`, which
            the benchmark publishes for 00 to 10 only.
    Time: times.txt, seconds since the first frame; every line is a frame. Scans (`velodyne/`) are untwisted there.
    World and faults: see `KittiSource`. Raises SourceError for what is missing as a whole.
    """

    layout = "a KITTI odometry sequence (sequences/00 with image_0, image_1, calib.txt and times.txt)"

    def __init__(self, where: str | os.PathLike[str]):
        self.folder, options = location(where, {"camera": "", "poses": ""})
        sequence = self.folder.resolve().name
        self.name = f"kitti_odometry_{sequence}"
        self.eyes = choose_pair(self.folder, options["camera"], {name: _has(self.folder, name) for name in PAIRS})
        self.calibration: KittiCalibration = read_calibration(self.folder / CALIBRATION)
        self._stamps = _stamps(self.folder / TIMES)
        self._check_numbers()
        self.camera = self.calibration.camera(*self.eyes, self._size())
        usual = self.folder.resolve().parents[1] / "poses" / f"{sequence}.txt"
        path = named_file(options["poses"], self.folder) if options["poses"] else usual
        self.poses = read_pose_file(path, len(self))

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with the times and an image pair as in KITTI odometry."""
        folder = Path(folder_of(where))
        return os.path.isfile(folder / TIMES) and any(_has(folder, name) for name in PAIRS)

    def __len__(self) -> int:
        return len(self._stamps)

    def images(self, i: int) -> tuple[Path, Path]:
        """Return the left and right image files of frame `i`."""
        left, right = (self.folder / f"image_{number}" / f"{i:06d}.png" for number in self.eyes)
        return left, right

    def stamp_ns(self, i: int) -> int:
        """Return the time of frame `i` in nanoseconds after the first."""
        return self._stamps[i]

    def velodyne(self, i: int) -> Path:
        """Return the scan's file of frame `i`."""
        return self.folder / "velodyne" / f"{i:06d}.bin"

    def _check_numbers(self) -> None:
        numbers = numbers_in(self.folder / f"image_{self.eyes[0]}", IMAGE)
        if numbers and int(numbers[-1]) >= len(self):
            path = self.folder / TIMES
            raise SourceError(f"{path}: has {len(self)} lines, but there is an image {numbers[-1]}.png; copy it again")


def _has(folder: Path, pair: str) -> bool:
    return all(os.path.isdir(folder / f"image_{number}") for number in PAIRS[pair])


def _stamps(path: Path) -> list[int]:
    """Return the times in nanoseconds; raises SourceError with the line."""
    stamps = []
    for n, line in enumerate(time_lines(path, "sequence"), 1):
        try:
            stamps.append(ns_from_seconds(line))
        except ValueError as error:
            raise SourceError(f"{path}:{n}: {error}; correct the line") from None
    return stamps
