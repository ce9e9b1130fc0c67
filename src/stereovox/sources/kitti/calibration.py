# SPDX-License-Identifier: Apache-2.0
"""KITTI's calibration files: `name: numbers` lines, in one file or in three."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import SourceError, StereovoxError
from stereovox.files.safe_io import read_text
from stereovox.geometry.se3 import Transform, orthonormalise, rigidity_error

CAM_TO_CAM, VELO_TO_CAM, IMU_TO_VELO = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"
ROUNDING = 1e-3
"""Largest rigidity error of the printed rotations."""
Values = Mapping[str, list[float]]


@dataclass(frozen=True, eq=False)
class KittiCalibration:
    """The rectified cameras 0 to 3 and the mounts of lidar and inertial unit.

    Camera 0, rectified, is the frame of reference. projections: (3, 4) by camera number, pixels from points in
    rectified camera 0. T_cam0_velo, T_velo_imu: (4, 4), None if the recording lacks them.
    where: file or folder it was read from, for messages.
    """

    projections: dict[int, NDArray[np.float64]]
    T_cam0_velo: Transform | None
    T_velo_imu: Transform | None
    where: str

    def camera(self, left: int, right: int, size: tuple[int, int]) -> PinholeCamera:
        """Return the rectified left camera of a pair for images of (width, height), with the pair's baseline.

        Raises SourceError if there is no such pair or its numbers are invalid.
        """
        P = self._projection(left)
        baseline = (self.offset_of(left) - self.offset_of(right))[0, 3]
        if not baseline > 0:
            where = f"P{left} and P{right} give a baseline of {baseline:g} m"
            raise SourceError(f"{self.where}: {where}; the second camera must be to the right of the first")
        try:
            return PinholeCamera(*size, float(P[0, 0]), float(P[1, 1]), float(P[0, 2]), float(P[1, 2]), float(baseline))
        except StereovoxError as error:
            raise SourceError(f"{self.where}: P{left}: {error}") from None

    def offset_of(self, number: int) -> Transform:
        """Return T_camera_cam0 (4, 4), which maps rectified camera 0 into rectified camera `number`: P = K [I | t]."""
        P = self._projection(number)
        T = np.eye(4)
        T[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
        return T

    def _projection(self, number: int) -> NDArray[np.float64]:
        if number not in self.projections:
            raise SourceError(
                f"{self.where}: no projection matrix of camera {number}; put the data set's own file back"
            )
        return self.projections[number]


def read_raw_calibration(folder: Path) -> KittiCalibration:
    """Return the calibration in the three files of KITTI raw in a date folder; raises SourceError.

    The files of lidar and inertial unit may be missing.
    """
    return from_raw_files(folder / CAM_TO_CAM, folder / VELO_TO_CAM, folder / IMU_TO_VELO)


def from_raw_files(cameras: Path, lidar: Path, imu: Path) -> KittiCalibration:
    """Return the calibration in three files of KITTI raw; `lidar` and `imu` may be missing."""
    values = read_values(cameras)
    rectify = _rotation(values, "R_rect_00", cameras)
    T_cam_velo, T_velo_imu = _rigid_file(lidar), _rigid_file(imu)
    T_cam0_velo = None if T_cam_velo is None else rectify @ T_cam_velo
    return KittiCalibration(_projections(values, "P_rect_0", cameras), T_cam0_velo, T_velo_imu, str(cameras))


def read_calibration(path: Path) -> KittiCalibration:
    """Return the calibration in a single file: KITTI tracking and object data, or odometry (`Tr`)."""
    values = read_values(path)
    if "Tr" in values:  # odometry: directly into rectified camera 0
        return KittiCalibration(_projections(values, "P", path), _rigid(values, "Tr", path), None, str(path))
    rectify = next((_rotation(values, key, path) for key in ("R_rect", "R0_rect") if key in values), None)
    T_cam_velo = next((_rigid(values, key, path) for key in ("Tr_velo_cam", "Tr_velo_to_cam") if key in values), None)
    T_velo_imu = next((_rigid(values, key, path) for key in ("Tr_imu_velo", "Tr_imu_to_velo") if key in values), None)
    T_cam0_velo = None if rectify is None or T_cam_velo is None else rectify @ T_cam_velo
    return KittiCalibration(_projections(values, "P", path), T_cam0_velo, T_velo_imu, str(path))


def read_values(path: Path) -> dict[str, list[float]]:
    """Return the numbers behind each name; the colon may be missing; other values (a date) are left out.

    Raises SourceError if the file cannot be read or has no such line.
    """
    try:
        lines = read_text(path).splitlines()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; put the data set's calibration there") from None
    except UnicodeDecodeError:
        raise SourceError(f"{path}: is not a text file; put the data set's calibration there") from None
    values = {}
    for name, *words in filter(None, map(str.split, lines)):
        try:
            values[name.rstrip(":")] = [float(word) for word in words]
        except ValueError:
            continue
    if not values:
        raise SourceError(f"{path}: holds no 'name: numbers' line; put the data set's calibration there")
    return values


def _projections(values: Values, prefix: str, path: Path) -> dict[int, NDArray[np.float64]]:
    found = {}
    for number in range(4):
        name = f"{prefix}{number}"
        if name in values:
            P = np.array(_numbers(values, name, 12, path)).reshape(3, 4)
            if P[0, 1] or P[1, 0] or not np.array_equal(P[2, :3], [0, 0, 1]) or min(P[0, 0], P[1, 1]) <= 0:
                raise SourceError(
                    f"{path}: {name} is not a projection of a rectified camera; put the original file back"
                )
            found[number] = P
    return found


def _rotation(values: Values, name: str, path: Path) -> Transform:
    T = np.eye(4)
    T[:3, :3] = np.array(_numbers(values, name, 9, path)).reshape(3, 3)
    return _checked(T, name, path)


def _rigid(values: Values, name: str, path: Path) -> Transform:
    T = np.eye(4)
    T[:3] = np.array(_numbers(values, name, 12, path)).reshape(3, 4)
    return _checked(T, name, path)


def _rigid_file(path: Path) -> Transform | None:
    """Return the motion in a file with lines `R` and `T`, None if there is no such file."""
    if not os.path.isfile(path):
        return None
    values = read_values(path)
    T = _rotation(values, "R", path)
    T[:3, 3] = _numbers(values, "T", 3, path)
    return T


def _checked(T: Transform, name: str, path: Path) -> Transform:
    if rigidity_error(T) > ROUNDING:
        raise SourceError(f"{path}: {name} is not a rotation; put the original file back")
    return orthonormalise(T)


def _numbers(values: Values, name: str, count: int, path: Path) -> list[float]:
    numbers = values.get(name, [])
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise SourceError(f"{path}: needs a line '{name}:' with {count} finite numbers; put the original file back")
    return numbers
