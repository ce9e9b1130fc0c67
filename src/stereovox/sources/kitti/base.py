# SPDX-License-Identifier: Apache-2.0
"""Common parts of the KITTI layouts: a rectified pair, a lidar, and poses of rectified camera 0."""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.rigs import StereoPair
from stereovox.errors import FrameRefused, SourceError, did_you_mean
from stereovox.files.safe_io import MAX_LIST, read_text
from stereovox.frame import StereoFrame, Viewpoint
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sources.base import Source
from stereovox.sources.kitti.calibration import KittiCalibration
from stereovox.sources.lidar import Box, LidarScan, read_velodyne
from stereovox.sources.photos import PICTURE_KINDS, common_size, file_names, read_picture_png

PAIRS = {"grey": (0, 1), "colour": (2, 3)}
"""Camera numbers of the left and right eye."""


class CameraPoses(Protocol):
    """Poses of camera 0 for each frame; see `kitti.poses`."""

    def at(self, i: int) -> Transform:
        """Return T_world_cam0 (4, 4); raises FrameRefused if missing."""
        ...


class KittiSource(Source, ABC):
    """Frames of a stereo pair with a lidar scan each, in one of KITTI's layouts.

    A layout sets `name`, `calibration`, `poses`, `eyes` (camera numbers left and right) and `camera`, and locates
    the files of each frame. World: see `FramePoses`. Pose of a frame: the rectified left camera in use.
    An unusable file gives a frame with a `fault`: one of `read_picture_png`, `no_pose`, `bad_pose_file`.
    Reasons of invalid pixels come from matching (see `depth.stereo`).
    """

    calibration: KittiCalibration
    poses: CameraPoses
    eyes: tuple[int, int]
    up = "z"

    @abstractmethod
    def images(self, i: int) -> tuple[Path, Path]:
        """Return the left and right image files of frame `i` (0 to len - 1)."""

    @abstractmethod
    def stamp_ns(self, i: int) -> int:
        """Return the time of frame `i` in nanoseconds."""

    @abstractmethod
    def velodyne(self, i: int) -> Path:
        """Return the scan file of frame `i`."""

    def pair(self, i: int) -> StereoPair:
        """Return the stereo pair of frame `i`."""
        return StereoPair(self.camera, name=self.name)

    def calibration_of(self, i: int) -> KittiCalibration:
        """Return the calibration of frame `i`."""
        return self.calibration

    def frame(self, i: int) -> StereoFrame:
        """Return frame `i`; images are (0, 0) and the pose is NaN if the frame has a `fault`."""
        i = range(len(self))[i]
        paths, stamp_ns, pair = self.images(i), self.stamp_ns(i), self.pair(i)
        try:
            T_world_left = self.viewpoint(i).T_world_camera
            size = (pair.camera.width, pair.camera.height)
            left, right = (read_picture_png(path, size) for path in paths)
        except FrameRefused as refused:
            no_image, no_pose = np.empty((0, 0), np.uint8), np.full((4, 4), np.nan)
            return StereoFrame(
                no_image, no_image, pair, no_pose, stamp_ns, str(paths[0]), refused.reason, fault_detail=str(refused)
            )
        return StereoFrame(left, right, pair, T_world_left, stamp_ns, str(paths[0]))

    def pose(self, i: int) -> Transform:
        """Return T_world_sensor (4, 4) of frame `i`, without its images; raises FrameRefused if it is missing."""
        return self.viewpoint(i).T_world_camera

    def viewpoint(self, i: int) -> Viewpoint:
        """Return the rectified left camera of frame `i`, its pose and time; FrameRefused if there is no pose."""
        i = range(len(self))[i]
        T_cam0_left = inverse(self.calibration_of(i).offset_of(self.eyes[0]))
        return Viewpoint(self.pair(i).camera.middle, self.poses.at(i) @ T_cam0_left, self.stamp_ns(i))

    @property
    def has_lidar(self) -> bool:
        """Whether there are lidar scans, and a calibration with the lidar's mount."""
        return self.calibration.T_cam0_velo is not None and os.path.isdir(self.velodyne(0).parent)

    def scan(self, i: int) -> LidarScan | None:
        """Return the scan of frame `i`; None or FrameRefused as in `LidarSource`."""
        i = range(len(self))[i]
        T_cam0_velo = self.calibration_of(i).T_cam0_velo
        if not self.has_lidar or T_cam0_velo is None:
            return None
        return LidarScan(read_velodyne(self.velodyne(i)), self.poses.at(i) @ T_cam0_velo, self.stamp_ns(i))

    def boxes(self, i: int) -> tuple[Box, ...]:
        """Return the annotated objects of frame `i`: none if the layout has no annotations."""
        range(len(self))[i]
        return ()

    def moving(self, i: int) -> NDArray[np.bool_] | None:
        """Return the mask of moving pixels, None if the recording has none."""
        range(len(self))[i]
        return None

    def _size(self) -> tuple[int, int]:
        """Return (width, height) of the left images; raises SourceError if none can be read."""
        paths = [self.images(i)[0] for i in range(len(self))]
        size = common_size(paths, kinds=PICTURE_KINDS)
        if size is None:
            folder = paths[0].parent if paths else self.name
            raise SourceError(f"{folder}: none of its {len(paths)} images is a readable 8-bit PNG; copy them again")
        return size


def time_lines(path: Path, whose: str) -> list[str]:
    """Return the stripped lines of a file of times; raises SourceError if missing."""
    try:
        lines = read_text(path, MAX_LIST, "replace").rstrip().splitlines()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; put the {whose}'s own file there") from None
    if not lines:
        raise SourceError(f"{path}: holds no time; put the {whose}'s own file there")
    return [line.strip() for line in lines]


def choose_pair(where: Path, camera: str, present: dict[str, bool]) -> tuple[int, int]:
    """Return the camera numbers of the pair named `camera`, or of the first present one (grey) for ''.

    Raises SourceError for an unknown name or a missing pair.
    """
    if camera and camera not in PAIRS:
        raise SourceError(f"{where}: camera={camera}{did_you_mean(camera, PAIRS)}")
    found = [name for name in PAIRS if present.get(name)]
    if not found or (camera and camera not in found):
        has = f"only {found[0]} images" if found else "no image pair (left and right folder)"
        raise SourceError(f"{where}: has {has}; " + ("leave camera= out" if found else "copy both image folders"))
    return PAIRS[camera or found[0]]


def numbers_in(folder: Path, pattern: re.Pattern[str]) -> list[str]:
    """Return the numbers (first group of `pattern`) of the files in `folder`, ascending, as written."""
    names = file_names(folder) if os.path.isdir(folder) else []
    return sorted({match[1] for name in names if (match := pattern.fullmatch(name))}, key=int)
