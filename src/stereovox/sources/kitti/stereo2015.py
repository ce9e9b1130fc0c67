# SPDX-License-Identifier: Apache-2.0
"""The scenes of KITTI's stereo benchmark of 2015."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair
from stereovox.errors import FrameRefused, SourceError
from stereovox.sources.kitti.base import KittiSource, numbers_in
from stereovox.sources.kitti.calibration import KittiCalibration, from_raw_files, read_calibration
from stereovox.sources.kitti.poses import StandingPoses
from stereovox.sources.photos import PICTURE_KINDS, png_size, read_picture_png
from stereovox.sources.rgbd.folder import folder_part
from stereovox.sources.rigs.rig_options import folder_and_options

SCENE = re.compile(r"(\d{6})_10\.png")
LEFT, RIGHT, MOVING = "image_2", "image_3", "obj_map"
SINGLE = "single scenes without poses: each is at the origin of its own world; map one, for example --frames 0:1"


class KittiStereo2015(KittiSource):
    """A folder `training` with image_2/000000_10.png and image_3; only this first pair of each scene is used.

    Calibration: `calib/000000.txt` (object data style), or calib_cam_to_cam/000000.txt with calib_velo_to_cam and
    calib_imu_to_velo next to it; scenes may differ, also in image size, so `camera` is the first one's.
    Scans: `velodyne/000000.bin`, which only some collections add to the benchmark. Moving objects: obj_map.
    World: camera 0 of each scene, upright; there are no poses. Time: one second for each scene number.
    Faults: see `KittiSource`. Raises SourceError if a calibration is missing or bad.
    """

    layout = "KITTI stereo 2015 scenes (training with image_2/000000_10.png and image_3)"

    def __init__(self, where: str | os.PathLike[str]):
        self.folder, _ = folder_and_options(where, {})
        self.name, self.eyes, self.poses = "kitti_stereo2015", (2, 3), StandingPoses()
        self._scenes = numbers_in(self.folder / LEFT, SCENE)
        if not self._scenes:
            raise SourceError(f"{self.folder / LEFT}: no 000000_10.png in it; give the folder 'training'")
        self._calibrations = [_calibration(self.folder, scene) for scene in self._scenes]
        self.calibration = self._calibrations[0]
        usual = self._size()
        self._cameras = [self._camera(i, usual) for i in range(len(self))]
        self.camera = self._cameras[0]
        self.notes = (f"{self.folder}: {SINGLE}",) if len(self) > 1 else ()

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with scenes as in KITTI stereo 2015."""
        folder = Path(folder_part(where))
        try:
            with os.scandir(folder / LEFT) as entries:
                return os.path.isdir(folder / RIGHT) and any(SCENE.fullmatch(entry.name) for entry in entries)
        except (OSError, ValueError):
            return False

    def __len__(self) -> int:
        return len(self._scenes)

    def images(self, i: int) -> tuple[Path, Path]:
        """Return the left and right image files of frame `i`."""
        left, right = (self.folder / eye / f"{self._scenes[i]}_10.png" for eye in (LEFT, RIGHT))
        return left, right

    def stamp_ns(self, i: int) -> int:
        """Return a stamp that distinguishes scenes: one second per number."""
        return int(self._scenes[i]) * 1_000_000_000

    def velodyne(self, i: int) -> Path:
        """Return the scan file of frame `i`."""
        return self.folder / "velodyne" / f"{self._scenes[i]}.bin"

    def pair(self, i: int) -> StereoPair:
        """Return the stereo pair of frame `i`."""
        return StereoPair(self._cameras[i], name=self.name)

    def calibration_of(self, i: int) -> KittiCalibration:
        """Return the calibration of frame `i`."""
        return self._calibrations[i]

    def moving(self, i: int) -> NDArray[np.bool_] | None:
        """Return the pixels of moving cars, None without `obj_map`; raises FrameRefused as `read_picture_png`."""
        i = range(len(self))[i]
        path, camera = self.folder / MOVING / f"{self._scenes[i]}_10.png", self._cameras[i]
        if not os.path.isdir(path.parent):
            return None
        objects = read_picture_png(path, (camera.width, camera.height))
        if objects.ndim != 2:
            raise FrameRefused("bad_dtype", f"{path}: colour image; object maps must be 8-bit grey")
        return objects != 0

    def _camera(self, i: int, usual: tuple[int, int]) -> PinholeCamera:
        try:
            size = png_size(self.images(i)[0], PICTURE_KINDS)
        except FrameRefused:  # reported when the frame is read
            size = usual
        return self._calibrations[i].camera(*self.eyes, size)


def _calibration(folder: Path, scene: str) -> KittiCalibration:
    """Return the calibration of a scene."""
    single = folder / "calib" / f"{scene}.txt"
    kinds = ("cam_to_cam", "velo_to_cam", "imu_to_velo")
    cameras, lidar, imu = (folder / f"calib_{kind}" / f"{scene}.txt" for kind in kinds)
    if os.path.isfile(cameras):
        return from_raw_files(cameras, lidar, imu)
    if not os.path.isfile(single):
        raise SourceError(f"{single}: no such file, nor {cameras}; put one of them there")
    return read_calibration(single)
