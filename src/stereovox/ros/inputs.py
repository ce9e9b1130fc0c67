# SPDX-License-Identifier: Apache-2.0
"""Convert messages (CDR bytes) to frames and scans with the bag readers, so that a bag and its replay give the same.

A frame waits for its pose, so a message is read twice: `header` gives its time and frame, `frame` converts it. `frame`
always returns a frame, whatever the message holds: with a `fault` if it cannot be used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, TypeVar

import numpy as np

from stereovox.cameras.lidar import Lidar
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.depth.cloud import deskewed
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import Cloud, Frame, Range, Rays, Scan
from stereovox.geometry.se3 import inverse
from stereovox.ros.poses.poses import Pose, PoseBuffer
from stereovox.sources.bags.depth_topic import (
    RECTIFIED,
    SUFFIXES,
    UNITS,
    camera_of,
    check_frame,
    decoded,
    plain_topic,
    sibling,
)
from stereovox.sources.bags.messages import Wire, read_camera_info, read_compressed, read_image
from stereovox.sources.bags.robot_messages import frame_name, read_laser_scan, read_point_cloud, read_range
from stereovox.sources.clouds.bag import cloud_of_scan, range_of_reading
from stereovox.sources.clouds.options import LidarOptions
from stereovox.sources.poses.poses import seconds_from_ns
from stereovox.sources.robots.bag import posed_scan
from stereovox.sources.robots.frames import CloudBand, scan_of_cloud

LONGEST_SWEEP_S = 0.5
"""Most seconds of a lidar's sweep; clouds whose points have later times do not wait for the poses of these."""
NO_POSE = np.full((4, 4), np.nan)
NO_CAMERA = PinholeCamera(1, 1, 1.0, 1.0, 0.0, 0.0)
SeenT = TypeVar("SeenT", Cloud, Range)
PoseLookup = Callable[[str, int], Pose]
"""Returns the pose of a frame (by its name) at a time in nanoseconds; raises FrameRefused."""


class Input(Protocol):
    """Input topic of the map.

    kind: its message type as `package/Name`.
    """

    topic: str
    kind: str

    @property
    def ready(self) -> bool:
        """Whether everything needed to convert messages, except the pose, is there."""
        return True

    def is_final(self, poses: PoseBuffer, frame_id: str, stamp_ns: int) -> bool:
        """Return whether no later message can change the pose of a message."""
        return poses.is_final(frame_id, stamp_ns)

    def frame(self, data: bytes, where: PoseLookup) -> Frame | Rays | Scan | None:
        """Convert a message; the `fault` of the result says why it cannot be used. None: do not map it."""
        ...

    def look_up(self, poses: PoseBuffer) -> PoseLookup:
        """Return the function by which `frame` looks up poses."""
        return poses.pose

    def view(self, data: bytes, stamp_ns: int) -> Frame | Cloud:
        """Return the evidence of a message about its sensor's motion: a depth image without pose, or an empty cloud."""
        name = _frame_title(self.topic, stamp_ns)
        return Cloud(np.empty((0, 3), np.float32), NO_POSE, stamp_ns, name=name, sensor=self.topic)


def header(data: bytes) -> tuple[int, str]:
    """Read time in nanoseconds and frame from the header at the start of a message; raises ValueError."""
    stamp_ns, frame_id = Wire(data, cdr=True).header()
    return stamp_ns, frame_name(frame_id)


class DepthInput(Input):
    """Depth images (16UC1, 32FC1, or compressed ones if the topic's name says so) and their camera_info."""

    def __init__(self, topic: str, info: str = ""):
        self.topic, self._packed = topic, topic.endswith(SUFFIXES)
        self.kind = "sensor_msgs/CompressedImage" if self._packed else "sensor_msgs/Image"
        self.info = info or sibling(plain_topic(topic), "camera_info")
        self._camera: PinholeCamera | None = None
        self._frame_id = ""
        self._trouble = f"{topic}: no camera_info on {self.info}; name its topic: --depth {topic}=INFO"

    @property
    def ready(self) -> bool:
        """Whether the camera is known."""
        return self._camera is not None

    def on_camera_info(self, data: bytes) -> None:
        """Process a `sensor_msgs/CameraInfo`; the newest valid one counts."""
        try:
            camera = camera_of(read_camera_info(Wire(data, cdr=True)), RECTIFIED.search(self.topic) is not None)
        except (StereovoxError, ValueError) as error:
            self._trouble = f"{self.info}: {error}"
            return
        if camera != self._camera:  # keep the same object: tables are cached by it
            self._camera = camera

    def view(self, data: bytes, stamp_ns: int) -> Frame | Cloud:
        """Return a depth image without its pose; an empty cloud if it cannot be read."""
        image = DepthInput.frame(self, data, lambda *_: Pose(NO_POSE, NO_POSE, 0))
        return super().view(data, stamp_ns) if image.fault else replace(image, stamp_ns=stamp_ns)

    def frame(self, data: bytes, where: PoseLookup) -> Frame:
        """Convert a depth image."""
        blank = Frame(np.empty((0, 0), np.uint16), NO_CAMERA, NO_POSE, name=self.topic, sensor=self.topic)
        try:
            stamp_ns, frame_id = header(data)
            blank = replace(blank, stamp_ns=stamp_ns, name=_frame_title(self.topic, stamp_ns))
            check_frame(frame_id, self._frame_id, blank.name)
            self._frame_id = frame_id
            if self._camera is None:
                raise FrameRefused("no_camera", self._trouble)
            wire, size = Wire(data, cdr=True), (self._camera.width, self._camera.height)
            picture = read_compressed(wire) if self._packed else read_image(wire)
            depth, encoding = decoded(picture, self._packed, size, blank.name)
            T_world_sensor, _, off_ns = where(frame_id, stamp_ns)
        except (FrameRefused, ValueError) as error:
            return replace(blank, **_fault(error, blank.name))
        return replace(
            blank, depth=depth, camera=self._camera, T_world_sensor=T_world_sensor, depth_scale=UNITS[encoding],
            pose_off_ns=off_ns,
        )  # fmt: skip


class CloudInput(Input):
    """Point clouds for a 3-D map, a ray for each point. If points have times, poses during the sweep deskew it.

    lidar: the reliability of their ranges.
    """

    kind = "sensor_msgs/PointCloud2"

    def __init__(self, topic: str, lidar: Lidar):
        self.topic, self._lidar, self._sweep_ns = topic, lidar, 0

    def is_final(self, poses: PoseBuffer, frame_id: str, stamp_ns: int) -> bool:
        """Return whether no later message can change a pose of a cloud's sweep, if it is as long as the last one."""
        return poses.is_final(frame_id, stamp_ns + self._sweep_ns)

    def frame(self, data: bytes, where: PoseLookup) -> Cloud:
        """Convert a cloud."""
        try:
            cloud = read_point_cloud(Wire(data, cdr=True))
            frame_id = frame_name(cloud.frame_id)
            found = _at(Cloud(cloud.points, NO_POSE, cloud.stamp_ns, self._lidar), self.topic, where, frame_id)
            if cloud.times_s is None:
                return found
            last_s = float(np.max(cloud.times_s, initial=0.0, where=np.isfinite(cloud.times_s)))
            self._sweep_ns = round(1e9 * last_s) if last_s <= LONGEST_SWEEP_S else 0
            return deskewed(found, cloud.times_s, lambda stamp_ns: where(frame_id, stamp_ns).T_world_sensor)
        except (FrameRefused, ValueError) as error:
            return _no_cloud(self.topic, error)


class RaysInput(Input):
    """Scans of a 2-D lidar for a 3-D map, a ray for each beam. options: the reliability of their ranges."""

    kind = "sensor_msgs/LaserScan"

    def __init__(self, topic: str, options: LidarOptions):
        self.topic, self._options = topic, options

    def frame(self, data: bytes, where: PoseLookup) -> Cloud:
        """Convert a laser scan."""
        try:
            scan = read_laser_scan(Wire(data, cdr=True))
            return _at(cloud_of_scan(scan, self._options), self.topic, where, frame_name(scan.frame_id))
        except (FrameRefused, StereovoxError, ValueError) as error:
            return _no_cloud(self.topic, error)


class RangeInput(Input):
    """Distances of a sonar or radar, for 3-D and floor maps. sigma, silence_clears: as for `range_of_reading`."""

    kind = "sensor_msgs/Range"

    def __init__(self, topic: str, sigma: float = 0.0, silence_clears: bool = False):
        self.topic, self._sigma, self._silence_clears = topic, sigma, silence_clears

    def frame(self, data: bytes, where: PoseLookup) -> Range | Cloud:
        """Convert a distance."""
        try:
            reading = read_range(Wire(data, cdr=True))
            found = range_of_reading(reading, self._sigma, self._silence_clears)
            return _at(found, self.topic, where, frame_name(reading.frame_id))
        except (FrameRefused, StereovoxError, ValueError) as error:
            return _no_cloud(self.topic, error)


class FloorCloudInput(Input):
    """Point clouds for a floor map, reduced to the view of a 2-D lidar (`robots.cloud_scan`)."""

    kind = "sensor_msgs/PointCloud2"

    def __init__(self, topic: str):
        self.topic = topic

    def frame(self, data: bytes, where: PoseLookup) -> Scan:
        """Convert a cloud to a scan."""
        try:
            cloud = read_point_cloud(Wire(data, cdr=True))
            T_world, T_base, off_ns = where(frame_name(cloud.frame_id), cloud.stamp_ns)
            scan_message, T_base_scan = scan_of_cloud(cloud, T_base, CloudBand())
        except (FrameRefused, ValueError) as error:
            return _no_scan(self.topic, error)
        T_world_scan = T_world @ inverse(T_base) @ T_base_scan
        scan = posed_scan(scan_message, T_world_scan, T_base_scan, _frame_title(self.topic, cloud.stamp_ns), off_ns)
        return replace(scan, sensor=self.topic)


class ScanInput(Input):
    """Scans of a 2-D lidar for a floor map."""

    kind = "sensor_msgs/LaserScan"

    def __init__(self, topic: str):
        self.topic = topic

    def frame(self, data: bytes, where: PoseLookup) -> Scan | None:
        """Convert a laser scan."""
        return self.scan(data, where)

    def scan(self, data: bytes, where: PoseLookup) -> Scan:
        """Convert a laser scan."""
        try:
            scan_message = read_laser_scan(Wire(data, cdr=True))
            T_world, T_base, off_ns = where(frame_name(scan_message.frame_id), scan_message.stamp_ns)
        except (FrameRefused, ValueError) as error:
            return _no_scan(self.topic, error)
        scan = posed_scan(scan_message, T_world, T_base, _frame_title(self.topic, scan_message.stamp_ns), off_ns)
        return replace(scan, sensor=self.topic)


def _at(seen: SeenT, topic: str, where: PoseLookup, frame_id: str) -> SeenT:
    """Return a cloud or range at the pose of its sensor. Raises FrameRefused."""
    T_world_sensor, _, off_ns = where(frame_id, seen.stamp_ns)
    name = _frame_title(topic, seen.stamp_ns)
    return replace(seen, T_world_sensor=T_world_sensor, pose_off_ns=off_ns, name=name, sensor=topic)


def _no_cloud(topic: str, error: Exception) -> Cloud:
    blank = Cloud(np.empty((0, 3), np.float32), NO_POSE, name=topic, sensor=topic)
    return replace(blank, **_fault(error, topic))


def _no_scan(topic: str, error: Exception) -> Scan:
    blank = Scan(np.empty(0, np.float32), 0.0, 0.0, 0.0, 0.0, NO_POSE, name=topic, sensor=topic)
    return replace(blank, **_fault(error, topic))


def _fault(error: Exception, name: str) -> dict[str, Any]:
    if isinstance(error, FrameRefused):
        return {"fault": error.reason, "fault_detail": str(error)}
    return {"fault": "unreadable", "fault_detail": f"{name}: {error}; the message is damaged"}


def _frame_title(topic: str, stamp_ns: int) -> str:
    return f"{topic} {seconds_from_ns(stamp_ns)}"
