# SPDX-License-Identifier: Apache-2.0
"""Folders of Microsoft's 7-Scenes data set (Kinect v1), and of others that use its layout."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from stereovox.errors import FrameRefused, SourceError
from stereovox.safe_io import read_text
from stereovox.se3 import Transform
from stereovox.sources.images import DepthFolder, file_names

FILE = re.compile(r"frame-(\d+)\.(depth\.png|pose\.txt)")
FRAMES_PER_SECOND = 30


class SevenScenes(DepthFolder):
    """`frame-000000.depth.png` (uint16 mm; 0 and 65535: no value) with `frame-000000.pose.txt` (4x4, camera to world).

    World: exactly that of the pose files. In 7-Scenes it is the optical frame of the first camera of the scene's model:
    x right, y down, z forward, so z is NOT up. It is left so because ground truth and other results for these folders
    are in it; heights in a picture are therefore distances from that first camera.
    Camera: `camera.toml` in the folder, else `camera-intrinsics.txt` there or one folder up; without them, 585 585 320
    240 as the data set's authors state, for 640x480 only. Baseline 0.075 m (Kinect v1).
    Time: the files hold none; frame number / 30 Hz, rounded down to whole nanoseconds.
    Every number that has an image or a pose is a frame. Faults: those of `read_depth_png`, `no_pose` (no file),
    `bad_pose_file` (not 16 numbers).
    """

    layout = "a 7-Scenes folder (frame-*.depth.png with frame-*.pose.txt)"
    depth_scale = 0.001
    baseline = 0.075
    intrinsics = (585.0, 585.0, 320.0, 240.0)

    def __init__(self, where: str | os.PathLike[str]):
        super().__init__(where)
        numbers = {match[1] for name in file_names(self.folder) if (match := FILE.fullmatch(name))}
        if not numbers:
            raise SourceError(f"{self.folder}: no frame-*.depth.png in it; give the folder that holds the images")
        self._numbers = sorted(numbers, key=int)
        self._set_camera(self.folder, self.folder.resolve().parent)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with at least one image or pose named as in 7-Scenes."""
        try:
            with os.scandir(where) as entries:
                return any(FILE.fullmatch(entry.name) for entry in entries)
        except (OSError, ValueError):
            return False

    def __len__(self) -> int:
        return len(self._numbers)

    def image(self, i: int) -> tuple[Path, int]:
        """Return the image file of frame `i` and its time in nanoseconds."""
        number = self._numbers[i]
        return self.folder / f"frame-{number}.depth.png", int(number) * 1_000_000_000 // FRAMES_PER_SECOND

    def pose(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) just as in the file; raises FrameRefused `no_pose` or `bad_pose_file`."""
        path = self.folder / f"frame-{self._numbers[i]}.pose.txt"
        try:
            numbers = [float(word) for word in read_text(path).split()]
        except FileNotFoundError:
            raise FrameRefused("no_pose", f"{path}: no such file; put it back or remove the image") from None
        except OSError as error:
            raise FrameRefused("bad_pose_file", f"{path}: {error.strerror}; make it readable") from None
        except ValueError as error:
            raise FrameRefused("bad_pose_file", f"{path}: {error}; write a 4x4 matrix of plain numbers") from None
        if len(numbers) != 16:
            raise FrameRefused("bad_pose_file", f"{path}: holds {len(numbers)} numbers; write a 4x4 matrix")
        return np.array(numbers).reshape(4, 4)

    @classmethod
    def depth_only(cls, where: str) -> SevenScenes:
        """Return the images without looking for poses: every pose is NaN."""
        return _Images(where)


class _Images(SevenScenes):
    def pose(self, i: int) -> Transform:
        return np.full((4, 4), np.nan)
