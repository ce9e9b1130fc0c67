# SPDX-License-Identifier: Apache-2.0
"""Scans of the app Record3D, exported as "EXR + RGB" (iPhone, iPad)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.errors import SourceError
from stereovox.files.safe_io import is_number, read_json
from stereovox.geometry.se3 import Transform, from_quaternion
from stereovox.sources.base import Part
from stereovox.sources.calibration.camera_file import FoundCamera, pinhole
from stereovox.sources.calibration.intrinsics import scaled
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part, images_in
from stereovox.sources.rgbd.pose_files import ImagePoses

FILES = ("metadata.json", "metadata")


class Record3D(DepthFolder):
    """`depth/*.exr` (float32 metres) with `metadata.json`, also in a folder `EXR_RGBD`.

    Poses: `qx qy qz qw tx ty tz`, camera to world in OpenGL axes, one for each image. World: ARKit's, y up. Camera:
    `K`, column by column, for pictures of `w` by `h`; scaled to the depth images. Times: number / `fps`.
    """

    up = "y"
    layout = "a Record3D export (depth/*.exr with metadata.json)"
    parts = (
        Part(("depth/*.exr", "EXR_RGBD/depth/*.exr"), "depth images"),
        Part(tuple(f"{place}{name}" for place in ("", "EXR_RGBD/") for name in FILES), "poses and camera"),
    )
    axes = "opengl"
    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the images in the order of their numbers."""
        inner = self.folder / "EXR_RGBD"
        place = inner if inner.is_dir() else self.folder
        self._path = next((place / name for name in FILES if (place / name).is_file()), place / FILES[0])
        self._table = _read(self._path)
        fps: Any = self._table.get("fps")
        if not self.options.fps and is_number(fps) and fps > 0:
            self.fps = float(fps)
        return images_in(place / "depth", r"\d+\.exr", self.fps)

    def read_poses(self) -> ImagePoses:
        """Return the poses, by the numbers of the images."""
        rows = self._table.get("poses")
        poses = [_pose(row, f"{self._path}: pose {n}") for n, row in enumerate(rows if isinstance(rows, list) else [])]
        numbers = self.numbers()
        if len(poses) != len(self) and max(numbers) >= len(poses):
            raise SourceError(f"{self._path}: holds {len(poses)} poses for {len(self)} images; export again")
        return ImagePoses(poses, str(self._path), list(range(len(poses)))).of(numbers)

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera of the pictures, scaled to the depth images."""
        K, width, height = (self._table.get(key) for key in ("K", "w", "h"))
        if not isinstance(K, list) or len(K) != 9 or not all(map(is_number, [*K, width, height])):
            raise SourceError(f"{self._path}: needs K, 9 numbers, and w and h; export again, or add ?camera=FILE")
        if not (isinstance(width, int | float) and isinstance(height, int | float) and min(width, height) > 0):
            raise SourceError(f"{self._path}: w and h must be positive; export again, or add ?camera=FILE")
        x, y = size[0] / width, size[1] / height
        if abs(x / y - 1) > 0.02:
            raise SourceError(f"{self._path}: is for {width:g}x{height:g} pictures, depth has {size[0]}x{size[1]}")
        try:
            return FoundCamera(pinhole(size, scaled([float(K[n]) for n in (0, 4, 6, 7)], x, y), None))
        except SourceError as error:
            raise SourceError(f"{self._path}: {error}") from None

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder exported by Record3D."""
        folder = folder_part(where)
        return os.path.isdir(folder) and all(part.count(folder) for part in cls.parts)


def _read(path: Path) -> dict[str, Any]:
    table = read_json(path)
    if not isinstance(table, dict):
        raise SourceError(f"{path}: is not a table; export again")
    return table


def _pose(row: Any, where: str) -> Transform | str:
    numbers = np.array(row, float) if isinstance(row, list) and all(map(is_number, row)) else np.empty(0)
    if numbers.shape != (7,) or not numbers[:4].any():
        return f"{where} is not qx qy qz qw tx ty tz; leave the image out"
    return from_quaternion(numbers[4:], numbers[:4])
