# SPDX-License-Identifier: Apache-2.0
"""Raw data exported by the app Polycam (`keyframes/`), from iPhones and iPads with a lidar."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import SourceError
from stereovox.files.safe_io import is_number, json_value, read_text
from stereovox.geometry.se3 import Transform
from stereovox.sources.base import Part
from stereovox.sources.calibration.camera_file import FoundCamera, pinhole
from stereovox.sources.calibration.intrinsics import scaled
from stereovox.sources.rgbd.depth_files import Depth, without_low
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part, images_in
from stereovox.sources.rgbd.pose_files import ImagePoses

NUMBERS = ("fx", "fy", "cx", "cy", "width", "height", *(f"t_{row}{column}" for row in range(3) for column in range(4)))


class Polycam(DepthFolder):
    """`keyframes/depth/*.png` (uint16 mm) with `corrected_cameras/*.json`, else `cameras/`, and `confidence/`.

    World: ARKit's, y up. Poses are optimised by the app (`corrected_cameras`), else ARKit's, with a note. Each image
    has its own camera, scaled from the picture's. Pixels of low confidence (0 of 0, 127, 255) are invalid.
    Times are in the names, in microseconds.
    """

    up = "y"
    layout = "Polycam's raw data (keyframes/depth/, keyframes/corrected_cameras/)"
    parts = (
        Part(("keyframes/depth/*.png", "depth/*.png"), "depth images"),
        Part(
            tuple(f"{place}{kind}/*.json" for place in ("keyframes/", "") for kind in ("corrected_cameras", "cameras")),
            "cameras",
            "export 'raw data' from Polycam again",
        ),
    )
    axes = "opengl"
    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the images in order of their times."""
        self._place = self.folder / "keyframes" if (self.folder / "keyframes").is_dir() else self.folder
        corrected = self._place / "corrected_cameras"
        self._files = corrected if corrected.is_dir() else self._place / "cameras"
        if self._files != corrected:
            self.notes += (
                f"{self._place}: has no corrected_cameras; poses are as ARKit tracked them, without loop closure",
            )
        images = images_in(self._place / "depth", r"\d+\.png", self.fps)
        self._tables = [_read(self._files / f"{image.path.stem}.json") for image in images]
        return images

    def read_poses(self) -> ImagePoses:
        """Return the poses of the images."""
        return ImagePoses(
            [table if isinstance(table, str) else _pose(table) for table in self._tables], str(self._files)
        )

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera of the first image that has one."""
        self._size = size
        table = next((table for table in self._tables if not isinstance(table, str)), None)
        if table is None:
            raise SourceError(f"{self._tables[0]}; no other camera can be read either, add ?camera=FILE")
        return FoundCamera(self._pinhole(table))

    def camera_of(self, i: int) -> PinholeCamera:
        """Return the camera of frame `i`."""
        table = self._tables[i]
        return self.camera if self.options.camera or isinstance(table, str) else self._pinhole(table)

    def read(self, i: int) -> Depth:
        """Return depth image `i` without pixels of low confidence; raises FrameRefused."""
        path = self.image(i).path
        return without_low(super().read(i), self._place / "confidence" / path.name, lowest=1)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with depth images and cameras named as by Polycam."""
        folder = folder_part(where)
        place = os.path.join(folder, "keyframes")
        place = place if os.path.isdir(place) else folder
        kinds = [os.path.join(place, name) for name in ("corrected_cameras", "cameras")]
        return any(map(os.path.isdir, kinds)) and all(part.count(folder) for part in cls.parts)

    def _pinhole(self, table: dict[str, float]) -> PinholeCamera:
        x, y = self._size[0] / table["width"], self._size[1] / table["height"]
        try:
            return pinhole(self._size, scaled([table[key] for key in NUMBERS[:4]], x, y), None)
        except SourceError as error:
            raise SourceError(f"{self._files}: {error}") from None


def _read(path: Path) -> dict[str, float] | str:
    """Return the numbers of a camera, or the fault of its file."""
    try:
        table: Any = json_value(read_text(path))
    except (OSError, ValueError):
        return f"{path}: cannot be read; leave the image out"
    if not isinstance(table, dict) or not all(is_number(table.get(key)) for key in NUMBERS):
        return f"{path}: lacks one of fx, fy, cx, cy, width, height, t_00 to t_23; leave the image out"
    if min(table["width"], table["height"]) <= 0:
        return f"{path}: width and height must be positive; leave the image out"
    return {key: float(table[key]) for key in NUMBERS}


def _pose(table: dict[str, float]) -> Transform:
    T = np.eye(4)
    T[:3] = np.reshape([table[key] for key in NUMBERS[6:]], (3, 4))
    return T
