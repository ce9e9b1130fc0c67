# SPDX-License-Identifier: Apache-2.0
"""Drives of KITTI raw data, synced and rectified."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from stereovox.errors import NoPoses, SourceError
from stereovox.sources.base import Part
from stereovox.sources.imu import ImuReadings, checked_imu, in_order
from stereovox.sources.kitti.base import (
    PAIRS,
    KittiSource,
    choose_pair,
    numbers_in,
    time_lines,
)
from stereovox.sources.kitti.calibration import CAM_TO_CAM, KittiCalibration, read_raw_calibration
from stereovox.sources.kitti.poses import FramePoses, read_named_poses, read_oxts_files, read_oxts_motions
from stereovox.sources.parameters import file_of
from stereovox.sources.poses.poses import UnknownPoses
from stereovox.sources.rgbd.folder import folder_part
from stereovox.sources.rigs.rig_options import POSES, folder_and_options

IMAGE = re.compile(r"(\d{10})\.png")
REFINED, INS, OXTS = "poses_refined.txt", "poses_ins.txt", "oxts"
POSE_FILES = {"refined": REFINED, "ins": INS}


class KittiRaw(KittiSource):
    """A drive folder `2011_09_26_drive_0001_sync`, with the three `calib_*.txt` in the date folder above it.

    where: the folder, or with options `DRIVE?camera=colour&poses=oxts`:
            camera: `grey` (image_00 and 01) or `colour` (02 and 03); default: grey if there are such images.
            poses: `refined` (`poses_refined.txt`), `ins` (`poses_ins.txt`), `oxts` (computed from the GPS and inertial
                packets), or a file of T_world_cam0 of any form (see `rgbd.pose_files`); default: the first that
                exists. axes: of the posed camera, `optical` (default), `opengl` or `ros`. invert: 1 for world to
                camera. imu: `off` to leave the inertial unit out.
        posed: if False, poses are not searched for, and are NaN.
        IMU: angular rates and accelerations of oxts, at oxts/timestamps.txt, as often as there are images.
        Time: image_0X/timestamps.txt of the left camera, exact to the nanosecond. Every line of it is a frame.
        World and faults: see `KittiSource`. Raises SourceError if a whole part is missing.
    """

    layout = "a KITTI raw drive (image_00 and image_01 with data/*.png; calib_*.txt next to the drive)"

    parts = (
        Part(("image_00/data", "image_02/data"), "left images (image_00/data)"),
        Part(("image_01/data", "image_03/data"), "right images (image_01/data)"),
        Part(("image_0?/timestamps.txt",), "image_00/timestamps.txt"),
    )

    def __init__(self, where: str | os.PathLike[str], posed: bool = True):
        self.folder, options = folder_and_options(where, {"camera": "", "imu": "", **POSES})
        self._imu = checked_imu(str(where), options["imu"])
        self.name = self.folder.resolve().name
        self.calibration = _calibration(self.folder)
        self.eyes = choose_pair(self.folder, options["camera"], {name: _has(self.folder, name) for name in PAIRS})
        self._stamps = _stamps(self._eye(0) / "timestamps.txt")
        self._check_numbers()
        self.camera = self.calibration.camera(*self.eyes, self._size())
        choice = (options["poses"], options["axes"], options["invert"])
        self.poses = self._poses(*choice) if posed else UnknownPoses()

    @classmethod
    def depth_only(cls, where: str) -> KittiRaw:
        """Return the images without searching for poses: every pose is NaN."""
        return cls(where, posed=False)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with the images of a grey or a colour pair as in KITTI raw."""
        return any(_has(Path(folder_part(where)), name) for name in PAIRS)

    def __len__(self) -> int:
        return len(self._stamps)

    def images(self, i: int) -> tuple[Path, Path]:
        """Return the left and right image files of frame `i`."""
        return self._eye(0) / "data" / f"{i:010d}.png", self._eye(1) / "data" / f"{i:010d}.png"

    def stamp_ns(self, i: int) -> int:
        """Return the time of frame `i` in nanoseconds since 1970, in the recording's own clock."""
        return self._stamps[i]

    def velodyne(self, i: int) -> Path:
        """Return the scan file of frame `i`."""
        return self.folder / "velodyne_points" / "data" / f"{i:010d}.bin"

    def imu(self) -> ImuReadings | None:
        """Return angular rates and accelerations of oxts; None if they or their mount are missing.

        Raises SourceError if they are damaged.
        """
        data, times, c = self.folder / OXTS / "data", self.folder / OXTS / "timestamps.txt", self.calibration
        if self._imu == "off" or not (os.path.isdir(data) and os.path.isfile(times)):
            return None
        if c.T_cam0_velo is None or c.T_velo_imu is None:
            return None
        stamps = _stamps(times)
        numbers = read_oxts_motions([data / f"{i:010d}.txt" for i in range(len(stamps))])
        mount = c.offset_of(self.eyes[0]) @ c.T_cam0_velo @ c.T_velo_imu
        return in_order(stamps, numbers[:, :3], numbers[:, 3:], mount, f"{self.name} oxts")

    def _eye(self, side: int) -> Path:
        return self.folder / f"image_{self.eyes[side]:02d}"

    def _check_numbers(self) -> None:
        numbers = numbers_in(self._eye(0) / "data", IMAGE)
        if numbers and int(numbers[-1]) >= len(self._stamps):
            path, lines = self._eye(0) / "timestamps.txt", len(self._stamps)
            raise SourceError(f"{path}: has {lines} lines, but there is an image {numbers[-1]}.png; copy it again")

    def _poses(self, choice: str, axes: str, inverted: bool) -> FramePoses:
        if not choice:
            there = [kind for kind, name in POSE_FILES.items() if os.path.isfile(self.folder / name)]
            choice = there[0] if there else OXTS
        if choice == OXTS:
            return self._oxts()
        path = self.folder / POSE_FILES[choice] if choice in POSE_FILES else file_of(choice, self.folder)
        return read_named_poses(path, self._stamps, axes, inverted)

    def _oxts(self) -> FramePoses:
        data = self.folder / OXTS / "data"
        if not os.path.isdir(data):
            raise NoPoses(f"{data}: no such folder, and no {REFINED}; put one of them there or name ?poses=FILE")
        c = self.calibration
        if c.T_cam0_velo is None or c.T_velo_imu is None:
            missing = "calib_velo_to_cam.txt" if c.T_cam0_velo is None else "calib_imu_to_velo.txt"
            raise SourceError(f"{Path(c.where).parent / missing}: no such file, poses from oxts need it; put it there")
        return read_oxts_files([data / f"{i:010d}.txt" for i in range(len(self))], c.T_cam0_velo @ c.T_velo_imu)


def _has(folder: Path, pair: str) -> bool:
    return all(os.path.isdir(folder / f"image_{number:02d}" / "data") for number in PAIRS[pair])


def _calibration(drive: Path) -> KittiCalibration:
    above = drive.resolve().parent
    return read_raw_calibration(drive if os.path.isfile(drive / CAM_TO_CAM) else above)


def _stamps(path: Path) -> list[int]:
    """Return the times `2011-09-26 14:05:35.913420800` in nanoseconds; raises SourceError with the line."""
    return [_stamp(line, f"{path}:{n}") for n, line in enumerate(time_lines(path, "drive"), 1)]


def _stamp(text: str, where: str) -> int:
    try:
        stamp = np.datetime64(text, "ns")
    except ValueError:
        stamp = np.datetime64("NaT", "ns")
    if np.isnat(stamp):
        raise SourceError(f"{where}: '{text}' is not a time like 2011-09-26 14:05:35.913420800; correct the line")
    return int(stamp.astype(np.int64))
