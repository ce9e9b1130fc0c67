# SPDX-License-Identifier: Apache-2.0
"""Write the drive through a simulated floor as a bag, with the topics and frames of the robot of IST 2019."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from heapq import merge

import numpy as np

from stereovox.errors import SourceError
from stereovox.frame import Frame, Scan
from stereovox.geometry import se2
from stereovox.geometry.se3 import Transform
from stereovox.simulate.floors.floor import Floor
from stereovox.sources.bags.writer import BagWriter
from stereovox.sources.robots.robot import Robot

BASE, LASER, CAMERA, OPTICAL = "base_link", "laser", "camera_link", "camera_depth_optical_frame"
TRUTH = "/ground_truth"
Recorded = tuple[int, Scan | Frame | se2.Pose]


def write_bag(
    robot: Robot | Floor, path: str | os.PathLike[str], progress: Callable[[int, int], None] | None = None
) -> None:
    """Write all recordings of a simulated robot: ROS 1 for `.bag`, ROS 2 for `.mcap` and `.db3`.

    Topics: /scan, /camera/depth/image_raw and its camera_info, /odom, /tf (odom -> base_link), /tf_static, and the true
    pose in the building on /ground_truth. Depth is in millimetres, 0 for none: a bag has no reasons. progress: called
    with the done and the total number of messages: odometry poses, scans and images. Raises SourceError for robots of
    other kinds and if the file cannot be written.
    """
    if not isinstance(robot, Floor):
        raise SourceError(f"{robot.name}: only a simulated robot can be recorded; give sim:floor")
    total = len(robot.odometry) + len(robot.scans) + len(robot.frames)
    with BagWriter(path) as bag:
        _fixed(bag, robot)
        for done, (stamp_ns, one) in enumerate(merge(*_streams(robot), key=lambda recorded: recorded[0]), 1):
            if isinstance(one, Scan):
                bag.scan(one, "/scan", LASER)
            elif isinstance(one, Frame):
                bag.depth(one, "/camera/depth/image_raw", OPTICAL)
            else:
                bag.odometry(stamp_ns, one)
                bag.pose(stamp_ns, se2.flattened(robot.truth.at(stamp_ns)), topic=TRUTH, frame_id="building")
            if progress:
                progress(done, total)


def _streams(robot: Floor) -> Iterator[Iterator[Recorded]]:
    odometry = zip(robot.odometry.stamps_ns.tolist(), robot.odometry.T_world_body, strict=True)
    yield ((stamp_ns, se2.flattened(T)) for stamp_ns, T in odometry)
    yield ((scan.stamp_ns, scan) for scan in robot.scans)
    yield ((frame.stamp_ns, frame) for frame in robot.frames)


def _fixed(bag: BagWriter, robot: Floor) -> None:
    """Write the sensors' mounts; the camera's body (x forward) contains its optical frame (z forward)."""
    T_link_optical: Transform = robot.T_base_camera.copy()
    T_link_optical[:3, 3] = 0
    T_base_link = np.eye(4)
    T_base_link[:3, 3] = robot.T_base_camera[:3, 3]
    bag.fixed(BASE, LASER, robot.T_base_lidar)
    bag.fixed(BASE, CAMERA, T_base_link)
    bag.fixed(CAMERA, OPTICAL, T_link_optical)
