# SPDX-License-Identifier: Apache-2.0
"""Poses and sensor mounts of a recorded robot: from tf, an odometry topic, options, or assumptions.

Convert a point cloud to the scan of a virtual 2-D lidar.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, SourceError, did_you_mean
from stereovox.geometry.se2 import flattened, lifted
from stereovox.geometry.se3 import Transform, inverse, transform_points
from stereovox.sources.bags.files import BagFile
from stereovox.sources.bags.robot_messages import LaserScan, PointCloud, frame_name
from stereovox.sources.bags.scans import first_odometry, odometry_edge, odometry_topic
from stereovox.sources.bags.tf import Edge, Limits, Tf, read_tf


@dataclass(frozen=True)
class CloudBand:
    """The part of a cloud that becomes a scan, in the robot's frame.

    lowest, highest: metres above the floor. range_min, range_max: metres from the sensor, seen from above; nearer
    points are the robot's own and are ignored. step: approximate width of a beam in radians.
    """

    lowest: float = 0.1
    highest: float = 1.8
    range_min: float = 0.1
    range_max: float = 20.0
    step: float = math.radians(0.5)


def scan_of_cloud(cloud: PointCloud, T_base_sensor: Transform, band: CloudBand) -> tuple[LaserScan, Transform]:
    """Return the scan of a full turn, and T_base_scan: its frame is upright at the sensor's position.

    A beam has the distance of its nearest point in the band; +inf if that is `range_max` or more; NaN if there is
    no point, since a cloud has no reason for it.
    """
    points = transform_points(T_base_sensor, cloud.points[np.isfinite(cloud.points).all(axis=1)])
    T_base_scan = lifted(flattened(T_base_sensor))
    T_base_scan[2, 3] = T_base_sensor[2, 3]
    points = points[(points[:, 2] >= band.lowest) & (points[:, 2] <= band.highest)]
    x, y, _ = transform_points(inverse(T_base_scan), points).T
    count = max(round(2 * np.pi / band.step), 1)
    step = 2 * np.pi / count
    ranges = nearest(np.hypot(x, y), np.arctan2(y, x), count, band)
    scan = LaserScan(cloud.stamp_ns, cloud.frame_id, -np.pi, step, band.range_min, band.range_max, ranges)
    return scan, T_base_scan


def nearest(
    distance: NDArray[np.float64], angle: NDArray[np.float64], count: int, band: CloudBand
) -> NDArray[np.float32]:
    """Return (count,) float32 ranges of beams that start backwards (-pi), with the nearest point of each."""
    beams = np.rint((angle + np.pi) * count / (2 * np.pi)).astype(np.int64) % count
    ranges = np.full(count, np.inf)
    far_enough = distance >= band.range_min
    np.minimum.at(ranges, beams[far_enough], distance[far_enough])
    seen = np.bincount(beams[far_enough], minlength=count) > 0
    return np.where(seen, np.where(ranges < band.range_max, ranges, np.inf), np.nan).astype(np.float32)


BASES = ("base_footprint", "base_link")
"""Names of the robot's frame; the first connected with its sensors is used (REP 120 and REP 105)."""
ODOMS = ("odom", "odom_combined")
Notes = tuple[str, ...]


@dataclass(frozen=True)
class FrameOptions:
    """Names given by the user; "" to search. odom: topic of nav_msgs/Odometry; truth: a topic that is not odometry."""

    odom: str = ""
    base_frame: str = ""
    odom_frame: str = ""
    truth: str = ""
    limits: Limits = field(default_factory=Limits)


class RobotFrames:
    """Poses of a robot's sensors in the world of its odometry.

    sensors: frames named by the sensors, "" if there is no name; they help to find the robot's own. tf: all
    transforms; empty without /tf. `mount` adds assumed ones. base, odom: frames of the robot and of its odometry; odom
    is "" if the robot is assumed to stand still. notes: assumptions made. Raises SourceError for given topics and
    frames that do not exist.
    """

    def __init__(self, file: BagFile, options: FrameOptions, sensors: tuple[str, ...]):
        self.path = file.path
        self.tf = read_tf(file, options.limits) or Tf(f"{file.path}", options.limits)
        self._sensors = [sensor for sensor in sensors if sensor in self.tf.frames]
        topic, noted = odometry_topic(file, options.odom, options.truth)
        first = first_odometry(file, topic) if topic else None
        self.base, based = self._find_base(frame_name(options.base_frame), first.child if first else "")
        self._edge: Edge | None = None
        self.odom, how = "" if options.odom else self._odom_in_tf(frame_name(options.odom_frame), bool(first)), ()
        if not self.odom and first and topic:
            child, said = self._body(first.child, topic)
            self._edge = odometry_edge(file, topic, first.parent or ODOMS[0], child)
            self.odom, how = self._edge.parent, (*noted, *said)
        if not self.odom:
            self.odom, how = self._moving_root()
        self.notes = (*based, *how, *self.tf.notes)

    def mount(self, sensor: str, alias: str, given: Transform | None, T_frame: Transform) -> tuple[str, Notes]:
        """Return the frame for looking up a sensor's poses, and notes.

        given: T_base_body of the options, which takes precedence over tf. T_frame: T_body_sensor of a frame unknown to
        tf (for a camera its optical frame). alias: name of the sensor in messages.
        """
        if given is not None:
            self.tf.add_fixed(self.base, f"{alias}?", given @ T_frame)
            return f"{alias}?", ()
        if sensor and (sensor == self.base or self.tf.connected(self.base, sensor)):
            return sensor, ()
        known = sensor in self.tf.frames
        try:
            top = self.tf.root(sensor) if known else sensor or alias
        except FrameRefused:  # a loop: lookups will be refused
            return sensor, ()
        self.tf.add_fixed(self.base, top, np.eye(4) if known else T_frame)
        option = "mount" if alias == "lidar" else f"{alias}_mount"
        said = f"the mount of the {alias} ({top}) on the robot is unknown: assumed to be {self.base} itself"
        return sensor or alias, (f"{self.path}: {said}; give ?{option}=x,y,z,yaw",)

    def in_base(self, sensor: str, stamp_ns: int) -> Transform:
        """Return T_base_sensor at a time; raises FrameRefused `no_pose`."""
        return self._between(self.base, sensor, stamp_ns)

    def in_odom(self, sensor: str, stamp_ns: int) -> Transform:
        """Return T_odom_sensor at a time; raises FrameRefused `no_pose`."""
        if self._edge:
            T_odom_child = self._edge.at(int(stamp_ns), self.tf.limits, f"{self.path}")
            return T_odom_child @ self._between(self._edge.child, sensor, stamp_ns)
        return self._between(self.odom or self.base, sensor, stamp_ns)

    def off_ns(self, sensor: str, stamp_ns: int) -> int:
        """Return how far `in_odom` extrapolates; raises FrameRefused `no_pose` as it does."""
        target, off = (self._edge.child, self._edge.off_ns(stamp_ns)) if self._edge else (self.odom or self.base, 0)
        return off if target == sensor else max(off, self.tf.off_ns(target, sensor, stamp_ns))

    def _between(self, target: str, source: str, stamp_ns: int) -> Transform:
        return np.eye(4) if target == source else self.tf.lookup(target, source, stamp_ns)

    def _find_base(self, given: str, child: str) -> tuple[str, Notes]:
        """Return the robot's frame; child: the child frame of the odometry topic."""
        if given:
            if self.tf.frames and given not in {*self.tf.frames, child}:
                known = did_you_mean(given, self.tf.frames)
                raise SourceError(f"{self.path}: base_frame={given} is in no transform{known}")
            return given, ()
        for name in BASES:
            if found := self._named(name, "base_frame"):
                return found, ()
        if child or not self._sensors or not self._moved(self._sensors[0]):
            return child or "base_link", ()
        said = f"no {' or '.join(BASES)} in /tf: {self._sensors[0]} is used as the robot; else give ?base_frame="
        return self._sensors[0], (f"{self.path}: {said}",)

    def _body(self, child: str, topic: str) -> tuple[str, Notes]:
        """Return the frame whose pose an odometry topic holds: its child frame, if that is connected with the robot."""
        if child in ("", self.base) or self.tf.connected(child, self.base):
            return child or self.base, ()
        return self.base, (f"{self.path}: {topic} has poses of {child}: assumed to be {self.base}",)

    def _named(self, name: str, option: str) -> str:
        """Return the frame of that name, or the only one of a namespace (`robot/base_link`), "" if missing."""
        near = [frame for frame in self.tf.frames if frame.rpartition("/")[2] == name]
        near = [frame for frame in near if any(self.tf.connected(frame, other) for other in self._sensors)] or near
        if len(near) > 1 and name not in near:
            raise SourceError(f"{self.path}: several robots, choose one: ?{option}={f' or ?{option}='.join(near)}")
        return name if name in near else "".join(near)

    def _odom_in_tf(self, given: str, has_topic: bool) -> str:
        """Return the odometry's frame if tf connects it with the robot's, else ""."""
        if not given:
            names = filter(None, (self._named(name, "odom_frame") for name in ODOMS))
            return next((name for name in names if self.tf.connected(name, self.base)), "")
        if self.tf.connected(given, self.base):
            return given
        if has_topic and not self.tf.frames:
            return ""
        try:
            self.tf.moving(given, self.base)  # raises with the reason
        except FrameRefused as refused:
            raise SourceError(f"{refused}; correct ?odom_frame={given}") from None
        return given

    def _moving_root(self) -> tuple[str, Notes]:
        """Return the root above the robot, if it moves there; else "": it is assumed to stand still."""
        if self.base in self.tf.frames and self._moved(self.base):
            root = self.tf.root(self.base)
            said = f"no {ODOMS[0]} in /tf: using poses of {self.base} in {root}; else give ?odom_frame="
            return root, (f"{self.path}: {said}",)
        said = "has no odometry: the robot is assumed to stand still until its path is found (stereovox slam)"
        return "", (f"{self.path}: {said}",)

    def _moved(self, frame: str) -> bool:
        try:
            return self.tf.moving(self.tf.root(frame), frame)
        except FrameRefused:
            return False
