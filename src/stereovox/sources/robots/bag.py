# SPDX-License-Identifier: Apache-2.0
"""Recordings of ground robots in ROS 1 and ROS 2 bags: scans, depth images, odometry, tf."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stereovox.errors import FrameRefused, SourceError
from stereovox.frame import Frame, Scan
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sources.bags import open_bag, suffix_of
from stereovox.sources.bags.depth_topic import DepthTopic, depth_topics, find_depth
from stereovox.sources.bags.files import BagFile
from stereovox.sources.bags.poses import topic_poses
from stereovox.sources.bags.recording import depth_frame, file_part, parse_as
from stereovox.sources.bags.robot_messages import LaserScan, PointCloud, frame_name
from stereovox.sources.bags.scans import busiest_topic, find_scans
from stereovox.sources.bags.tf import Limits
from stereovox.sources.base import Lazy
from stereovox.sources.parameters import mounted
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.tracker import AXES
from stereovox.sources.robots.frames import CloudBand, FrameOptions, RobotFrames, scan_of_cloud

NO_POSE = np.full((4, 4), np.nan)
T_BODY_OPTICAL = np.eye(4)
"""An optical frame (z forward) in a body that faces the same direction (x forward, z up)."""
T_BODY_OPTICAL[:3, :3] = AXES["ros"].T


@dataclass(frozen=True)
class RobotOptions:
    """Options after the file's name, as in `walk.bag?scan=/front_scan&mount=0.04,0,0.225,0`.

    scan, depth, info, odom, truth: topics of scans (or point clouds), depth images, their CameraInfo, odometry
        (nav_msgs/Odometry, instead of tf) and true poses of the robot, if they are not found or the wrong ones are.
    base_frame, odom_frame: frames of the robot and of its odometry.
    mount, camera_mount: mounts of lidar and camera on the robot, instead of tf: x,y,z in metres, then yaw, pitch and
        roll in radians, of which the last may be left out. A camera without rotation points forward.
    axes: `ros` if depth images name the camera's body (x forward) as their frame, not its optical frame.
    scale: metres per unit of depth (0: the file's). range_max: metres, instead of the scans' own.
    max_gap: seconds, the longest gap in tf that is bridged; extrapolate: seconds for which its first and last transform
        hold.
    lowest, highest: metres above the floor between which points of a cloud count.
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


class RobotBag:
    """A ground robot's scans, depth images and odometry in a bag of ROS 1 (`.bag`) or ROS 2.

    Topics are found by their types; if there are several, the one with the most messages is used, and a note names the
    others. Scans come from a lidar (LaserScan), or else are computed from point clouds.

    World: the frame of the odometry (`odom` in tf); without it, poses of a nav_msgs/Odometry topic; without either, the
    robot is assumed to stand still, which SLAM can correct. A pose is looked up in tf at the time of the scan or image,
    interpolated; gaps longer than `max_gap` are not bridged. Sensors without a mount in tf are assumed to be
    at the robot's own frame (`base_footprint`, else `base_link`). All assumptions are reported in `notes`.

    Invalid pixels are as in `Bag`. At the ends of tf a pose is held for `extrapolate` seconds (`pose_off_ns`).
    Order: as recorded, which is that of the stamps unless the clock was set back meanwhile.
    Faults: `unreadable`, `no_pose`, for images also `bad_dtype` and `bad_shape`.
    Raises SourceError for files that are empty, damaged or without scans and depth, and for bad options.
    """

    layout = "a bag with scans or depth images of a robot"

    def __init__(self, where: str | Path):
        path, options = parse_as(str(where), RobotOptions)
        file = open_bag(path)
        self.name, self._options = path.name, options
        self._depth, depth_notes = _find_depth(file, options)
        depth_frame_id = frame_name(self._depth.frame_id) if self._depth else ""
        self._scans, scan_notes = find_scans(file, options.scan, options.range_max, depth_frame_id)
        if not (self._scans or self._depth):
            pixels = ", ".join(f"{name} ({kind})" for name, kind in sorted(file.types.items())[:5]) or "nothing at all"
            why = f"{depth_notes[0]}; else" if depth_notes else f"{path}:"
            raise SourceError(f"{why} no scans, point clouds or depth images in it; it holds {pixels}")
        limits = Limits(options.max_gap, options.extrapolate)
        chosen = FrameOptions(options.odom, options.base_frame, options.odom_frame, options.truth, limits)
        scan_frame_id, range_notes = (self._scans.frame_id, self._scans.notes) if self._scans else ("", ())
        self.where = RobotFrames(file, chosen, (scan_frame_id, depth_frame_id))
        self._lidar, lidar_notes = self._mount_lidar(scan_frame_id)
        self._camera, camera_notes = self._mount_camera(depth_frame_id)
        self.truth: Poses | None = _truth(file, options.truth)
        scan_notes = (*scan_notes, *range_notes)
        self.notes = (*file.notes, *scan_notes, *depth_notes, *self.where.notes, *lidar_notes, *camera_notes)
        self.scans: Sequence[Scan] = Lazy(self._scan, range(len(self._scans or ())))
        self.frames: Sequence[Frame] = Lazy(self._frame, range(len(self._depth or ())))

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is, or by its name should be, a bag; options may follow. Never raises."""
        return bool(suffix_of(file_part(where)))

    def _mount_lidar(self, frame_id: str) -> tuple[str, tuple[str, ...]]:
        if not self._scans:
            return "", ()
        return self.where.mount(frame_id, "lidar", mounted("mount", self._options.mount), np.eye(4))

    def _mount_camera(self, frame_id: str) -> tuple[str, tuple[str, ...]]:
        if not self._depth:
            return "", ()
        T_frame = T_BODY_OPTICAL if self._options.axes == "optical" else np.eye(4)
        given = mounted("camera_mount", self._options.camera_mount)
        camera, notes = self.where.mount(frame_id, "camera", given, T_frame)
        return camera, (*self._depth.notes, *notes)

    def _scan(self, i: int) -> Scan:
        topic = self._scans
        assert topic
        blank = Scan(
            np.empty(0, np.float32), 0.0, 0.0, 0.0, 0.0, NO_POSE, stamp_ns=topic.recorded_ns(i), name=topic.name(i)
        )
        try:
            message = topic.read(i)
            blank = replace(blank, stamp_ns=message.stamp_ns)
            sensor = self._lidar if message.frame_id == topic.frame_id else message.frame_id
            T_base, T_odom = (look(sensor, message.stamp_ns) for look in (self.where.in_base, self.where.in_odom))
            off_ns = self.where.off_ns(sensor, message.stamp_ns)
        except FrameRefused as refused:
            return replace(blank, fault=refused.reason, fault_detail=str(refused))
        if isinstance(message, LaserScan):
            return posed_scan(message, T_odom, T_base, blank.name, off_ns)
        assert isinstance(message, PointCloud)
        band = CloudBand(self._options.lowest, self._options.highest)
        band = replace(band, range_max=self._options.range_max or band.range_max)
        flat, T_base_scan = scan_of_cloud(message, T_base, band)
        return posed_scan(flat, T_odom @ inverse(T_base) @ T_base_scan, T_base_scan, blank.name, off_ns)

    def _frame(self, i: int) -> Frame:
        images = self._depth
        assert images
        name = f"{self.where.path} {images.topic} message {i}"
        frame = depth_frame(images, i, name, self._camera_pose, images.camera, self._options.scale)
        return frame if frame.fault else replace(frame, pose_off_ns=self.where.off_ns(self._camera, frame.stamp_ns))

    def _camera_pose(self, stamp_ns: int) -> Transform:
        T = self.where.in_odom(self._camera, stamp_ns)
        return T if self._options.axes == "optical" else T @ T_BODY_OPTICAL


def posed_scan(message: LaserScan, T_odom_sensor: Transform, T_base_sensor: Transform, name: str, off_ns: int) -> Scan:
    """Return a message as a scan. off_ns: as `Scan.pose_off_ns`."""
    angles = message.angle_min, message.angle_step
    limits = message.range_min, message.range_max
    return Scan(
        message.ranges, *angles, *limits, T_odom_sensor, T_base_sensor, stamp_ns=message.stamp_ns, name=name,
        pose_off_ns=off_ns,
    )  # fmt: skip


def _find_depth(file: BagFile, options: RobotOptions) -> tuple[DepthTopic | None, tuple[str, ...]]:
    """Return the named depth images, or else those of the busiest topic, and notes; None if missing.

    Unless they were named, unusable images (without CameraInfo) only give a note.
    """
    if options.depth:
        return find_depth(file, options.depth, options.info), ()
    found, notes = depth_topics(file), ()
    if not found:
        return None, ()
    best = busiest_topic(file, found)
    if len(found) > 1:
        others = ", ".join(name for name in found if name != best)
        notes = (f"{file.path}: depth images of {best}; there are {others} too: add ?depth=/topic for them",)
    try:
        return find_depth(file, best, options.info), notes
    except SourceError as error:
        if options.info:
            raise
        return None, (f"{error}; depth images are left out",)


def _truth(file: BagFile, topic: str) -> Poses | None:
    if not topic:
        return None
    found = topic_poses(file, topic)
    if not isinstance(found.poses, Poses):
        raise SourceError(f"{file.path}: {topic}: no pose can be read; name another with ?truth=/topic")
    return found.poses
