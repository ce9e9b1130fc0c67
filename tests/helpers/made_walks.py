# SPDX-License-Identifier: Apache-2.0
"""A small bag: a depth camera on a robot that drives towards a wall with a pole before it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import wire

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.frame import Frame
from stereovox.geometry.se3 import Transform
from stereovox.sources.bags.writer import BagWriter
from stereovox.sources.poses.tracker import AXES

CAMERA = PinholeCamera.from_field_of_view(48, 36, 70.0)
START_NS = 1_700_000_000_000_000_000
FRAME_NS, TF_NS = 100_000_000, 40_000_000
DEPTH, OPTICAL = "/camera/depth/image_raw", "camera_depth_optical_frame"
T_BASE_CAMERA = np.eye(4)
T_BASE_CAMERA[:3, :3] = AXES["ros"].T
T_BASE_CAMERA[:3, 3] = 0.1, 0.0, 0.4


def base_at(stamp_ns: int) -> Transform:
    """T_odom_base: 0.3 m/s ahead, turning a little."""
    seconds = (stamp_ns - START_NS) / 1e9
    yaw = 0.2 * np.sin(seconds)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[0, 3] = 0.3 * seconds
    return T


def depth_at(k: int) -> Frame:
    """Frame k: a wall across x = 2.1 m, a pole before it at x = 1.3 m."""
    stamp_ns = START_NS + k * FRAME_NS
    T = base_at(stamp_ns) @ T_BASE_CAMERA
    columns, rows = CAMERA.rays()
    across = np.stack(np.broadcast_arrays(columns, rows[:, :1], rows[:, 1:]), axis=-1) @ T[:3, :3].T
    wall_m, pole_m = ((x - T[0, 3]) / across[..., 0] for x in (2.1, 1.3))
    pole = (pole_m > 0) & (abs(T[1, 3] + pole_m * across[..., 1]) < 0.08)
    depth = np.where(pole, pole_m, np.maximum(wall_m, 0))
    depth[0] = 0
    return Frame((1000 * depth).round().astype(np.uint16), CAMERA, T, stamp_ns, 0.001)


def write_room(path: Path, frames: list[Frame]) -> Path:
    """Write images of a camera that is tracked, without any pose."""
    with BagWriter(path) as bag:
        for frame in frames:
            bag.depth(replace(frame, stamp_ns=START_NS + frame.stamp_ns), DEPTH, OPTICAL)
    return path


def write_walk(path: Path, frames: int = 12, odometry: bool = False) -> Path:
    """Write depth, camera_info, /tf and /tf_static in order of time; transforms go on after the last image.

    odometry: poses of the camera itself on /odom take the place of transforms.
    """
    told = [(START_NS - FRAME_NS // 4 + k * TF_NS, k) for k in range(2 + frames * FRAME_NS // TF_NS)]
    with BagWriter(path) as bag:
        if not odometry:
            bag.fixed("base_link", OPTICAL, T_BASE_CAMERA)
        for stamp_ns, k in sorted([*told, *((START_NS + k * FRAME_NS, -k) for k in range(frames))]):
            if (stamp_ns - START_NS) % FRAME_NS == 0 and k <= 0:
                bag.depth(depth_at(-k), DEPTH, OPTICAL)
            elif odometry:
                message = wire.messages().odometry(np.zeros(3), stamp_ns, "odom", OPTICAL)
                message.pose.pose = wire.messages()._pose(base_at(stamp_ns) @ T_BASE_CAMERA)
                bag._write("/odom", "nav_msgs/msg/Odometry", stamp_ns, message)
            else:
                bag.transform(stamp_ns, "odom", "base_link", base_at(stamp_ns))
    return path
