# SPDX-License-Identifier: Apache-2.0
"""What may be said about a robot's recording behind the file's name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereovox.errors import SourceError
from stereovox.geometry import Transform, rotation_matrix
from stereovox.sources.cloud_scan import CloudBand
from stereovox.sources.tf_edge import Limits


@dataclass(frozen=True)
class RobotOptions:
    """What may stand behind the file's name, as in `walk.bag?scan=/front_scan&mount=0.04,0,0.225,0`.

    scan, depth, info, odom, truth: topics of scans (or point clouds), depth images, their CameraInfo, odometry
        (nav_msgs/Odometry, in place of tf) and true poses of the robot, where they are not found or not the right ones.
    base_frame, odom_frame: frames of the robot and of its odometry.
    mount, camera_mount: where lidar and camera sit on the robot, in place of tf: x,y,z in metres, then yaw, pitch and
        roll in radians, of which the last may be left out. A camera without turn looks forward.
    axes: `ros` where depth images name the camera's body (x forward) as their frame, not its optical frame.
    scale: metres per unit of depth (0: as the file says). range_max: metres, in place of what the scans say.
    max_gap, extrapolate: seconds, see `tf_edge.Limits`.
    lowest, highest: metres over the floor between which points of a cloud count.
    """

    scan: str = ""
    depth: str = ""
    info: str = ""
    odom: str = ""
    truth: str = ""
    base_frame: str = ""
    odom_frame: str = ""
    mount: str = ""
    camera_mount: str = ""
    axes: str = "optical"
    scale: float = 0.0
    range_max: float = 0.0
    max_gap: float = Limits().max_gap_s
    extrapolate: float = Limits().extrapolate_s
    lowest: float = CloudBand().lowest
    highest: float = CloudBand().highest

    def __post_init__(self) -> None:
        for key in ("scale", "range_max", "max_gap", "extrapolate"):
            if getattr(self, key) < 0:
                raise SourceError(f"{key}={getattr(self, key):g} must be a positive number")
        if self.axes not in ("optical", "ros"):
            raise SourceError(f"axes={self.axes} must be optical or ros")
        if self.lowest >= self.highest:
            raise SourceError(f"lowest={self.lowest:g} must be below highest={self.highest:g}")
        for key in ("mount", "camera_mount"):
            mounted(key, getattr(self, key))


def mounted(key: str, text: str) -> Transform | None:
    """Return T_base_body of `x,y,z,yaw,pitch,roll`, None for ""; raises SourceError for anything else."""
    if not text:
        return None
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if not (3 <= len(numbers) <= 6 and np.isfinite(numbers).all()):
        raise SourceError(f"{key}={text} must be x,y,z,yaw in metres and radians; pitch and roll may follow")
    yaw, pitch, roll = (*numbers[3:], 0.0, 0.0, 0.0)[:3]
    T = np.eye(4)
    T[:3, :3] = rotation_matrix([0, 0, yaw]) @ rotation_matrix([0, pitch, 0]) @ rotation_matrix([roll, 0, 0])
    T[:3, 3] = numbers[:3]
    return T
