# SPDX-License-Identifier: Apache-2.0
"""Folders of Microsoft's 7-Scenes data set (Kinect v1), and of others that use its layout."""

from __future__ import annotations

import os
import re

import numpy as np

from stereovox.se3 import Transform
from stereovox.sources.base import Part
from stereovox.sources.camera_file import FoundCamera, find_camera
from stereovox.sources.images import file_names
from stereovox.sources.rgbd.folder import SECOND, DepthFolder, ImageFile, folder_part
from stereovox.sources.rgbd.pose_files import read_pose

FILE = re.compile(r"frame-(\d+)\.(depth\.png|pose\.txt)")


class SevenScenes(DepthFolder):
    """`frame-000000.depth.png` (uint16 mm; 0 and 65535: no value) with `frame-000000.pose.txt` (4x4, camera to world).

    World: exactly that of the pose files. In 7-Scenes it is the optical frame of the first camera of the scene's model:
    x right, y down, z forward, so z is NOT up. It is left so because ground truth and other results for these folders
    are in it; heights in a picture are therefore distances from that first camera.
    Camera: `camera.toml` in the folder, else `camera-intrinsics.txt` there or one folder up; without them, 585 585 320
    240 as the data set's authors state, for 640x480 only. Baseline 0.075 m (Kinect v1).
    Time: the files hold none; frame number / 30 Hz, rounded down to whole nanoseconds.
    Every number that has an image or a pose is a frame. Faults: those of `read_depth`, `no_pose` (no file),
    `bad_pose_file` (not 16 numbers).
    """

    layout = "a 7-Scenes folder (frame-*.depth.png with frame-*.pose.txt)"
    parts = (Part(("frame-*.depth.png",), "depth images"), Part(("frame-*.pose.txt",), "poses"))
    depth_scale = 0.001
    baseline = 0.075
    intrinsics = (585.0, 585.0, 320.0, 240.0)

    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the image files in the order of their numbers, which all that have a pose or an image are in."""
        numbers = {match[1] for name in file_names(self.folder) if (match := FILE.fullmatch(name))}
        return [
            ImageFile(self.folder / f"frame-{number}.depth.png", int(int(number) * SECOND / self.fps))
            for number in sorted(numbers, key=int)
        ]

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera from the folder or the one above."""
        folders = [self.folder, self.folder.resolve().parent]
        return find_camera(folders, size, self.baseline, self.intrinsics, self.calibrations)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with at least one image or pose named as in 7-Scenes."""
        try:
            with os.scandir(folder_part(where)) as entries:
                return any(FILE.fullmatch(entry.name) for entry in entries)
        except (OSError, ValueError):
            return False

    def pose_in_file(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) just as in the file; raises FrameRefused `no_pose` or `bad_pose_file`."""
        if self._poses is not None:
            return super().pose_in_file(i)
        return read_pose(self._images[i].path.with_name(self._images[i].path.name.replace("depth.png", "pose.txt")))

    @classmethod
    def depth_only(cls, where: str) -> SevenScenes:
        """Return the images without looking for poses: every pose is NaN."""
        return _Images(where)


class _Images(SevenScenes):
    posed = False

    def pose_in_file(self, i: int) -> Transform:
        return np.full((4, 4), np.nan)
