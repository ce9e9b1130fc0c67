# SPDX-License-Identifier: Apache-2.0
"""Scans of iPhones and iPads by the app Stray Scanner (ARKit)."""

from __future__ import annotations

import re
from pathlib import Path

from stereovox.errors import SourceError
from stereovox.files.safe_io import MAX_LIST, read_text
from stereovox.geometry.se3 import Transform, from_quaternion
from stereovox.sources.base import Part
from stereovox.sources.calibration.camera_file import FoundCamera, pinhole
from stereovox.sources.calibration.intrinsics import read_intrinsics, scaled
from stereovox.sources.photos import file_names
from stereovox.sources.poses.trajectory import ns_from_seconds
from stereovox.sources.rgbd.depth_files import Depth, without_low
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part
from stereovox.sources.rgbd.pose_files import ImagePoses

POSES, CAMERA, IMAGES, CONFIDENCE = "odometry.csv", "camera_matrix.csv", "depth", "confidence"
COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
FILE = re.compile(r"(\d+)\.(png|npy)")
WIDTHS = (1920, 1440, 1280, 960, 640, 480)
"""Possible columns of these phones' pictures; camera_matrix.csv is for the picture, but lacks its size."""
OFF_CENTRE = 0.15
"""Largest relative distance of the optical axis from the middle of the picture."""
Row = tuple[int, Transform | str]


class StrayScanner(DepthFolder):
    """`depth/000000.png` (uint16 mm, 256x192) with odometry.csv, camera_matrix.csv and confidence/.

    World: ARKit's, y up, origin at the start of the scan. Poses are of the optical axes, one per image, with its time.
    Camera: camera_matrix.csv is for the picture (1920x1440) and is scaled to the depth images. Pixels of low confidence
    (0 of 0, 1, 2) are invalid. An image without a line in odometry.csv has no pose.
    """

    up = "y"
    layout = "a Stray Scanner folder (depth/*.png with odometry.csv and camera_matrix.csv)"
    parts = (
        Part((f"{IMAGES}/*.png", f"{IMAGES}/*.npy"), "depth images"),
        Part((POSES,), "poses"),
        Part((CAMERA,), "camera"),
    )
    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the images in the order of their numbers, with the times of odometry.csv."""
        self._rows = _rows(self.folder / POSES)
        found = [match for name in file_names(self.folder / IMAGES) if (match := FILE.fullmatch(name))]
        numbers = {int(match[1]): match[0] for match in sorted(found, key=lambda match: match[0], reverse=True)}
        self._numbers = sorted(numbers)
        stamps = [self._rows[n][0] if n in self._rows else None for n in self._numbers]
        known = [stamp for stamp in stamps if stamp is not None]
        if len(known) < len(stamps):
            self.notes = (f"{self.folder / POSES}: has no line for {len(stamps) - len(known)} images",)
        last, files = min(known, default=0), []
        for n, stamp in zip(self._numbers, stamps, strict=True):
            last = last + 1 if stamp is None else stamp  # refused anyway without a pose
            files.append(ImageFile(self.folder / IMAGES / numbers[n], last))
        return files

    def read_poses(self) -> ImagePoses:
        """Return the poses of odometry.csv."""
        missing = f"{self.folder / POSES}: has no line for the image"
        return ImagePoses([self._rows.get(n, (0, missing))[1] for n in self._numbers], str(self.folder / POSES))

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the picture's camera, scaled to the depth images."""
        if (self.folder / "camera.toml").is_file():
            return super().find_camera(size)
        path = self.folder / CAMERA
        fx, fy, cx, cy = read_intrinsics(path)
        width = min(WIDTHS, key=lambda width: abs(2 * cx / width - 1))
        if abs(2 * cx / width - 1) > OFF_CENTRE:
            raise SourceError(f"{path}: cx = {cx:g} is not the middle of a usual picture; add ?camera=FILE")
        factor = size[0] / width
        if abs(2 * cy * factor / size[1] - 1) > OFF_CENTRE:
            raise SourceError(
                f"{path}: cy = {cy:g} is not the middle of pictures shaped as the depth images; add ?camera=FILE"
            )
        numbers = scaled((fx, fy, cx, cy), factor)
        note = f"{path} is assumed to be for {width} columns; its numbers are scaled to {size[0]}x{size[1]}"
        return FoundCamera(pinhole(size, numbers, None), (note,))

    def read(self, i: int) -> Depth:
        """Return depth image `i` without pixels of low confidence; raises FrameRefused."""
        path = self.image(i).path
        return without_low(super().read(i), self.folder / CONFIDENCE / f"{path.stem}.png", lowest=1)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with the files of the app."""
        return all(part.count(folder_part(where)) for part in cls.parts)


def _rows(path: Path) -> dict[int, Row]:
    """Return time in nanoseconds and pose, or its fault, by the number of the image."""
    try:
        header, *lines = read_text(path, MAX_LIST, "replace").splitlines() or [""]
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; make it readable") from None
    names = [name.strip() for name in header.split(",")]
    if not set(COLUMNS) <= set(names):
        raise SourceError(f"{path}: its first line must name the columns {', '.join(COLUMNS)}")
    found: dict[int, Row] = {}
    for n, line in enumerate(lines, 2):
        if not line.strip():
            continue
        try:
            words = dict(zip(names, (word.strip() for word in line.split(",")), strict=True))
            found.setdefault(int(words["frame"]), (ns_from_seconds(words["timestamp"]), _pose(words, f"{path}:{n}")))
        except ValueError as error:
            raise SourceError(f"{path}:{n}: {error}; correct or delete the line") from None
    if not found:
        raise SourceError(f"{path}: holds no pose; scan again")
    return found


def _pose(words: dict[str, str], where: str) -> Transform | str:
    numbers = [float(words[name]) for name in COLUMNS[2:]]
    if not any(numbers[3:]):
        return f"{where}: a quaternion of length zero; correct it"
    return from_quaternion(numbers[:3], numbers[3:])
