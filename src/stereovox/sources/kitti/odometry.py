# SPDX-License-Identifier: Apache-2.0
"""Sequences of KITTI's odometry benchmark."""

from __future__ import annotations

import os
import re
from pathlib import Path

from stereovox.errors import NoPoses, SourceError
from stereovox.sources.base import Part
from stereovox.sources.kitti.base import (
    PAIRS,
    KittiSource,
    choose_pair,
    numbers_in,
    time_lines,
)
from stereovox.sources.kitti.calibration import KittiCalibration, read_calibration
from stereovox.sources.kitti.poses import FramePoses, read_named_poses
from stereovox.sources.parameters import file_of
from stereovox.sources.poses.poses import UnknownPoses
from stereovox.sources.poses.trajectory import ns_from_seconds
from stereovox.sources.rgbd.folder import folder_part
from stereovox.sources.rigs.rig_options import POSES, folder_and_options

IMAGE = re.compile(r"(\d{6})\.png")
CALIBRATION, TIMES = "calib.txt", "times.txt"
FPS, SECOND_NS = 10.0, 1_000_000_000


class KittiOdometry(KittiSource):
    """A folder `sequences/00` with image_0 and image_1 (grey) or image_2 and image_3 (colour), calib.txt, times.txt.

    where: the folder, or with options `sequences/00?camera=colour&poses=FILE`:
            camera: `grey` or `colour`; default: grey if there are such images.
            poses: a file of T_world_cam0 of any form (see `rgbd.pose_files`); default: `poses/00.txt` next to
                `sequences`, which the benchmark publishes for 00 to 10 only.
            axes: of the posed camera, `optical` (default), `opengl` or `ros`. invert: 1 for world to camera.
            fps: frames a second if there is no times.txt; default 10.
        posed: if False, poses are not searched for, and are NaN.
        Time: times.txt, seconds since the first frame; every line is a frame. Scans (`velodyne/`) are already deskewed.
        World and faults: see `KittiSource`. Raises SourceError if a whole part is missing.
    """

    layout = "a KITTI odometry sequence (sequences/00 with image_0, image_1, calib.txt and times.txt)"

    parts = (
        Part(("image_0", "image_2"), "left images (image_0)"),
        Part(("image_1", "image_3"), "right images (image_1)"),
        Part((CALIBRATION,), CALIBRATION, "copy it from the data set, with lines 'P0: 12 numbers' to 'P3:'"),
    )

    def __init__(self, where: str | os.PathLike[str], posed: bool = True):
        self.folder, options = folder_and_options(where, {"camera": "", "fps": 0.0, **POSES})
        sequence = self.folder.resolve().name
        self.name = f"kitti_odometry_{sequence}"
        self.eyes = choose_pair(self.folder, options["camera"], {name: _has(self.folder, name) for name in PAIRS})
        self.calibration: KittiCalibration = read_calibration(self.folder / CALIBRATION)
        self._stamps = self._times(options["fps"])
        self._check_numbers()
        self.camera = self.calibration.camera(*self.eyes, self._size())
        choice = (options["poses"], options["axes"], options["invert"])
        self.poses = self._poses(*choice) if posed else UnknownPoses()

    @classmethod
    def depth_only(cls, where: str) -> KittiOdometry:
        """Return the images without searching for poses: every pose is NaN."""
        return cls(where, posed=False)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with an image pair and times or a calibration as in KITTI odometry."""
        folder = Path(folder_part(where))
        return any(os.path.isfile(folder / name) for name in (TIMES, CALIBRATION)) and any(
            _has(folder, name) for name in PAIRS
        )

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
        """Return the scan file of frame `i`."""
        return self.folder / "velodyne" / f"{i:06d}.bin"

    def _poses(self, choice: str, axes: str, inverted: bool) -> FramePoses:
        folder = self.folder.resolve()
        path = file_of(choice, self.folder) if choice else folder.parents[1] / "poses" / f"{folder.name}.txt"
        if not choice and not os.path.isfile(path):
            raise NoPoses(f"{path}: no such file; put it there or choose other poses (?poses=)")
        return read_named_poses(path, self._stamps, axes, inverted)

    def _times(self, fps: float) -> list[int]:
        """Return the times of all frames in nanoseconds; from numbers if there is no list or `fps` is given."""
        if not fps and os.path.isfile(self.folder / TIMES):
            return _stamps(self.folder / TIMES)
        folder = self.folder / f"image_{self.eyes[0]}"
        numbers = numbers_in(folder, IMAGE)
        if not numbers:
            raise SourceError(f"{folder}: no 000000.png in it; give a folder with images")
        if not fps:
            fps = FPS
            self.notes = (f"{self.folder} has no {TIMES}: assuming {fps:g} frames a second; else add ?fps=",)
        return [int(i * SECOND_NS / fps) for i in range(int(numbers[-1]) + 1)]

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
