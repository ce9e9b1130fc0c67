# SPDX-License-Identifier: Apache-2.0
"""Poses of KITTI recordings, one for each frame: from pose files, or from GPS and inertial unit (oxts)."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, SourceError
from stereovox.files.safe_io import MAX_LIST, read_text
from stereovox.geometry.se3 import Transform, inverse, orthonormalise, rigidity_error
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.pose_files import in_optical_axes
from stereovox.sources.rigs.rig_options import poses_of_images

EARTH_RADIUS = 6378137.0
"""Metres, the value of KITTI's own development kit."""
OXTS_FIELDS = 6
"""Numbers used of an oxts packet's 30: latitude, longitude, altitude, roll, pitch, yaw."""
OXTS_MOTION = (17, 18, 19, 11, 12, 13)
"""Positions of wx wy wz and of ax ay az in a packet."""
UPRIGHT = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""T_world_optical: turns optical axes (x right, y down, z forward) into the world's (x forward, y left, z up)."""
UPRIGHT.setflags(write=False)
ROUNDING = 5e-3


class FramePoses:
    """The pose of rectified camera 0 for each frame, in a world defined by that camera at the first frame, upright.

    T_any_cam0: for each frame (4, 4) in any world, or its fault in one line. World of the result of `at`:
    z up, x forward, y left and origin at camera 0 of the first frame that has a pose.
    Raises SourceError if no frame has a pose.
    """

    def __init__(self, T_any_cam0: Sequence[Transform | str], where: str):
        first = next((T for T in T_any_cam0 if not isinstance(T, str)), None)
        if first is None:
            said = T_any_cam0[0] if T_any_cam0 else "it is empty"
            raise SourceError(f"{where}: holds no usable pose ({said})")
        T_world_any = UPRIGHT @ inverse(first)
        self._poses = [T if isinstance(T, str) else T_world_any @ T for T in T_any_cam0]
        self.where = where

    def __len__(self) -> int:
        return len(self._poses)

    def at(self, i: int) -> Transform:
        """Return T_world_cam0 (4, 4) of frame `i`; raises FrameRefused `no_pose` or `bad_pose_file`."""
        if i >= len(self._poses):
            raise FrameRefused("no_pose", f"{self.where}: has no pose for frame {i}; leave it out or add one")
        found = self._poses[i]
        if isinstance(found, str):
            raise FrameRefused("bad_pose_file", found)
        return found.copy()


class StandingPoses:
    """The pose of independent scenes: always camera 0 at the origin of an upright world."""

    def at(self, i: int) -> Transform:
        """Return T_world_cam0 (4, 4), the same for every frame."""
        return UPRIGHT.copy()


def read_pose_file(path: Path, frames: int) -> FramePoses:
    """Return the poses in a file of `frames` lines, each 12 numbers: the 3x4 matrix T_world_cam0, row by row.

    Fewer lines leave the last frames without a pose. Raises SourceError if the file cannot be read or
    has more lines than there are frames, and so belongs to another recording.
    """
    lines = _frame_lines(path, frames)
    return FramePoses([_pose(line, f"{path}:{n}") for n, line in enumerate(lines, 1)], str(path))


def read_named_poses(path: Path, stamps_ns: Sequence[int], axes: str = "", inverted: bool = False) -> FramePoses:
    """Return the poses of camera 0 in a file or folder that an option names, one for each of the times `stamps_ns`.

    Twelve numbers a line are read by `read_pose_file`, any other form by `poses_of_images`. axes: of the posed
    camera, `optical` if empty. inverted: they map the world into the camera. Raises SourceError.
    """
    if not os.path.isdir(path) and _is_kitti(path):
        found = [_pose(line, f"{path}:{n}") for n, line in enumerate(_frame_lines(path, len(stamps_ns)), 1)]
    else:
        poses = poses_of_images(path, stamps_ns)
        found = [_at(poses, stamp) for stamp in stamps_ns]
    axes = axes or "optical"
    return FramePoses([T if isinstance(T, str) else in_optical_axes(T, axes, inverted) for T in found], str(path))


def _is_kitti(path: Path) -> bool:
    """Return whether the first line has twelve words, or there is none."""
    try:
        lines = read_text(path, MAX_LIST, "replace").split("\n", 1)
    except OSError:
        return True  # the reader reports the error
    return len(lines[0].split()) in (0, 12)


def _at(poses: Poses, stamp_ns: int) -> Transform | str:
    try:
        return poses.at(stamp_ns)
    except FrameRefused as refused:
        return str(refused)


def read_oxts_file(path: Path, frames: int, T_cam0_imu: Transform) -> FramePoses:
    """Return the poses in a file with one oxts packet a line, one a frame (KITTI tracking); lengths as above."""
    packets = [_packet(line, f"{path}:{n}") for n, line in enumerate(_frame_lines(path, frames), 1)]
    return FramePoses(camera_poses(packets, T_cam0_imu), str(path))


def read_oxts_files(paths: Sequence[Path], T_cam0_imu: Transform) -> FramePoses:
    """Return the poses in files with one oxts packet each (KITTI raw); a missing one affects only its own frame."""
    packets = [_packet_file(path) for path in paths]
    return FramePoses(camera_poses(packets, T_cam0_imu), str(paths[0].parent) if paths else "oxts")


def read_oxts_motions(paths: Sequence[Path]) -> NDArray[np.float64]:
    """Return wx wy wz in rad/s and ax ay az in m/s^2, (N, 6), of files with one oxts packet each.

    Along the vehicle's axes, x forward, y left, z up. NaN if a file is missing or too short.
    """
    packets = [_packet_file(path) for path in paths]
    found = np.full((len(packets), 6), np.nan)
    for row, packet in zip(found, packets, strict=True):
        if not isinstance(packet, str) and len(packet) > max(OXTS_MOTION):
            row[:] = packet[list(OXTS_MOTION)]
    return found


def camera_poses(packets: Sequence[NDArray[np.float64] | str], T_cam0_imu: Transform) -> list[Transform | str]:
    """Return T_world_cam0 for each packet (latitude, longitude in degrees, altitude, roll, pitch, yaw in radians).

    World: east, north, up, by the Mercator projection of KITTI's development kit (`convertOxtsToPose`), scaled for
    the first packet's latitude. T_cam0_imu: (4, 4), calib_velo_to_cam times calib_imu_to_velo, rectified. A packet
    that is a string (its fault) is kept.
    """
    first = next((packet for packet in packets if not isinstance(packet, str)), None)
    if first is None:
        return [str(packet) for packet in packets]
    scale = math.cos(math.radians(first[0]))
    T_imu_cam0 = inverse(T_cam0_imu)
    return [packet if isinstance(packet, str) else imu_pose(packet, scale) @ T_imu_cam0 for packet in packets]


def imu_pose(packet: NDArray[np.float64], scale: float) -> Transform:
    """Return T_world_imu (4, 4) of the packet's first six numbers; `scale` is the Mercator projection's."""
    latitude, longitude, altitude, roll, pitch, yaw = packet[:OXTS_FIELDS]
    T = np.eye(4)
    T[:3, :3] = _about(2, yaw) @ _about(1, pitch) @ _about(0, roll)
    T[0, 3] = scale * EARTH_RADIUS * math.radians(longitude)
    T[1, 3] = scale * EARTH_RADIUS * math.log(math.tan(math.radians(90 + latitude) / 2))
    T[2, 3] = altitude
    return T


def _about(axis: int, angle: float) -> NDArray[np.float64]:
    """Return the (3, 3) rotation about an axis (0: x) by `angle` radians."""
    R = np.eye(3)
    j, k = (axis + 1) % 3, (axis + 2) % 3
    R[j, j] = R[k, k] = math.cos(angle)
    R[k, j], R[j, k] = math.sin(angle), -math.sin(angle)
    return R


def _pose(line: str, where: str) -> Transform | str:
    numbers = _floats(line)
    T = np.eye(4)
    if len(numbers) != 12:
        return f"{where}: holds {len(numbers)} numbers; write the 12 of a 3x4 matrix"
    T[:3] = numbers.reshape(3, 4)
    if rigidity_error(T) > ROUNDING:
        return f"{where}: is not a rigid motion; correct the line or leave its frame out"
    return orthonormalise(T)


def _packet_file(path: Path) -> NDArray[np.float64] | str:
    try:
        return _packet(read_text(path, errors="replace"), str(path))
    except OSError as error:
        return f"{path}: {error.strerror}; put it back or leave its frame out"


def _packet(line: str, where: str) -> NDArray[np.float64] | str:
    numbers = _floats(line)
    if len(numbers) < OXTS_FIELDS or not np.isfinite(numbers[:OXTS_FIELDS]).all() or not abs(numbers[0]) < 89:
        return f"{where}: needs latitude, longitude, altitude, roll, pitch, yaw; correct it or leave its frame out"
    return numbers


def _floats(line: str) -> NDArray[np.float64]:
    """Return the numbers of a line, an empty array if a word is not a number."""
    try:
        return np.array([float(word) for word in line.split()])
    except ValueError:
        return np.empty(0)


def _frame_lines(path: Path, frames: int) -> list[str]:
    try:
        lines = read_text(path, MAX_LIST, "replace").splitlines()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; put it there or choose other poses (?poses=)") from None
    while lines and not lines[-1].strip():
        lines.pop()
    if len(lines) > frames:
        raise SourceError(f"{path}: {len(lines)} poses for {frames} frames; name the file of this recording")
    return lines
