# SPDX-License-Identifier: Apache-2.0
"""Folders of Microsoft's 7-Scenes data set (Kinect v1), and of others that use its layout (BundleFusion, 3RScan)."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import SourceError
from stereovox.files.safe_io import read_text
from stereovox.geometry.se3 import Transform
from stereovox.sources.base import Part
from stereovox.sources.calibration.camera_file import FoundCamera, camera_in, find_camera, pinhole
from stereovox.sources.calibration.intrinsics import NAMES
from stereovox.sources.photos import file_names
from stereovox.sources.rgbd.folder import SECOND, DepthFolder, ImageFile, folder_part
from stereovox.sources.rgbd.pose_files import read_pose

FILE = re.compile(r"frame-(\d+)\.(depth\.png|depth\.pgm|pose\.txt)")
PHOTO = re.compile(r"frame-(\d+)\.color\.(?:jpg|jpeg|png|ppm)")
COLOUR = "color-intrinsics.txt"
KINECT_COLOUR, KINECT_BASELINE = (525.0, 525.0, 319.5, 239.5), 0.025
"""fx, fy, cx, cy of a Kinect's colour camera for 640x480, and its distance to the right of the depth camera, metres.

These are typical values; single devices are some pixels and millimetres off."""
INFO = ("info.txt", "_info.txt")
"""BundleFusion's and 3RScan's file with m_calibrationDepthIntrinsic and m_depthShift."""


class SevenScenes(DepthFolder):
    """`frame-000000.depth.png` (uint16 mm; 0 and 65535: no value) with `frame-000000.pose.txt` (4x4, camera to world).

    World: exactly that of the pose files. In 7-Scenes it is the optical frame of the first camera of the scene's model:
    x right, y down, z forward, so z is NOT up. It is kept because ground truth and other results for these folders
    use it; heights in a picture are therefore distances from that first camera.
    Camera: `camera.toml` in the folder, else `camera-intrinsics.txt` or another program's file there or one folder up,
    also the `info.txt` of BundleFusion and 3RScan, which also has the unit; without them, 585 585 320 240 from the
    data set's authors, for 640x480 only. Baseline 0.075 m (Kinect v1).
    Time: the files have none; frame number / 30 Hz, rounded down to whole nanoseconds.
    Every number with an image or a pose is a frame. Faults: those of `read_depth`, `no_pose` (no file),
    `bad_pose_file` (not 16 numbers).
    """

    layout = "a 7-Scenes folder (frame-*.depth.png with frame-*.pose.txt)"
    parts = (Part(("frame-*.depth.png", "frame-*.depth.pgm"), "depth images"), Part(("frame-*.pose.txt",), "poses"))
    depth_scale = 0.001
    baseline = 0.075
    intrinsics = (585.0, 585.0, 320.0, 240.0)

    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the image files in the order of their numbers, one for each number with a pose or an image."""
        names = file_names(self.folder)
        numbers = {match[1] for name in names if (match := FILE.fullmatch(name))}
        suffix = "png" if any(name.endswith(".depth.png") for name in names) else "pgm"
        return [
            ImageFile(self.folder / f"frame-{number}.depth.{suffix}", int(int(number) * SECOND / self.fps))
            for number in sorted(numbers, key=int)
        ]

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera from the folder or the one above."""
        folders = [self.folder, self.folder.resolve().parent]
        names = [name for name in INFO if any(_tells_camera(folder / name) for folder in folders)]
        return find_camera(folders, size, self.baseline, self.intrinsics, (*names, *NAMES))

    def list_photos(self) -> list[ImageFile]:
        """Return the colour images of a Kinect, whose mount on the depth camera is known."""
        if any(_tells_camera(folder / name) for folder in (self.folder, self.folder.resolve().parent) for name in INFO):
            return []
        found = [(int(match[1]), name) for name in file_names(self.folder) if (match := PHOTO.fullmatch(name))]
        return [ImageFile(self.folder / name, int(number * SECOND / self.fps)) for number, name in found]

    def photo_camera(self, size: tuple[int, int]) -> tuple[PinholeCamera | None, Transform]:
        """Return the camera of `color-intrinsics.txt` (3x3), else a Kinect's, and the default mount."""
        T_depth_photo = np.eye(4)
        T_depth_photo[0, 3] = KINECT_BASELINE
        return _colour_camera(self.folder, size), T_depth_photo

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with at least one image or pose named as in 7-Scenes."""
        try:
            with os.scandir(folder_part(where)) as entries:
                return any(FILE.fullmatch(entry.name) for entry in entries)
        except (OSError, ValueError):
            return False

    def pose_in_file(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) exactly as in the file; raises FrameRefused `no_pose` or `bad_pose_file`."""
        if self._poses is not None:
            return super().pose_in_file(i)
        path = self._images[i].path
        return read_pose(path.with_name(re.sub(r"depth\.\w+$", "pose.txt", path.name)))

    @classmethod
    def depth_only(cls, where: str) -> SevenScenes:
        """Return the images without searching for poses: every pose is NaN."""
        return _Images(where)


def _colour_camera(folder: Path, size: tuple[int, int]) -> PinholeCamera | None:
    try:
        return camera_in(folder / COLOUR, size, None).camera if os.path.isfile(folder / COLOUR) else _kinect(size)
    except SourceError:
        return None


def _kinect(size: tuple[int, int]) -> PinholeCamera | None:
    return pinhole(size, KINECT_COLOUR, None) if size == (640, 480) else None


def _tells_camera(path: Path) -> bool:
    try:
        return os.path.isfile(path) and "m_calibrationDepthIntrinsic" in read_text(path, errors="replace")
    except (OSError, ValueError):
        return False


class _Images(SevenScenes):
    posed = False

    def pose_in_file(self, i: int) -> Transform:
        return np.full((4, 4), np.nan)
