# SPDX-License-Identifier: Apache-2.0
"""Convert messages (CDR bytes) to frames and scans with the bag readers, so that a bag and its replay give the same.

A frame waits for its pose, so a message is read twice: `header` gives its time and frame, `frame` converts it. Whatever
a message holds, `frame` returns a frame: with a `fault` where it cannot be used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import WIDEST_DEG, SphericalCamera
from stereovox.depth.sphere.image import T_BODY_GRID
from stereovox.depth.sphere.layout import SphereLayout
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import Frame, Reason, Scan
from stereovox.ros.poses import Pose, PoseBuffer
from stereovox.se3 import Transform, inverse
from stereovox.sources.bags.depth_topic import RECTIFIED, UNITS, camera_of, decoded, sibling
from stereovox.sources.bags.messages import Wire, read_camera_info, read_compressed, read_image
from stereovox.sources.bags.robot_messages import PointCloud, frame_name, read_laser_scan, read_point_cloud
from stereovox.sources.poses import seconds_from_ns
from stereovox.sources.robots.bag import posed_scan
from stereovox.sources.robots.cloud_scan import CloudBand, scan_of_cloud

EXACT = 1e-6
"""Disparity error in pixels of a lidar, practically zero: only the settings under `noise` count."""
NO_POSE = np.full((4, 4), np.nan)
NO_CAMERA = PinholeCamera(1, 1, 1.0, 1.0, 0.0, 0.0)
COMPRESSED = "/compressedDepth"
PoseLookup = Callable[[str, int], Pose]
"""Returns the pose of a frame (by its name) at a time in nanoseconds; raises FrameRefused."""


def frame_of_cloud(cloud: PointCloud, T_world_sensor: Transform, step_deg: float, name: str, sensor: str) -> Frame:
    """Return a cloud as the frame of a spherical camera where its sensor stands (x forward, y left, z up).

    A pixel is `step_deg` wide in azimuth and elevation and has the distance of the nearest of its points from the
    sensor's z axis. One without points is masked, and clears nothing: a cloud does not tell where it looked. Points
    within two degrees of the z axis have no such depth and are left out.
    """
    camera, columns, layout = _eye(step_deg)
    points = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(float)
    cells = layout.cells_of(points)
    level = np.hypot(points[:, 0], points[:, 1])
    seen = (cells >= 0) & (level > 0)
    depth = np.full(layout.azimuths * layout.polars, np.inf)
    np.minimum.at(depth, cells[seen], level[seen])
    depth[np.isinf(depth)] = np.nan
    image = depth.reshape(layout.shape)[:, columns].astype(np.float32)
    reason = np.where(np.isnan(image), np.uint8(Reason.MASKED), np.uint8(Reason.VALID))
    return Frame(image, camera, T_world_sensor @ T_BODY_GRID, cloud.stamp_ns, reason=reason, name=name, sensor=sensor)


@lru_cache(maxsize=4)
def _eye(step_deg: float) -> tuple[SphericalCamera, NDArray[np.int64], SphereLayout]:
    """Return the camera, which polar cells of the layout are its columns, and the layout of all directions."""
    half_turn = max(round(180 / step_deg), 18)
    layout = SphereLayout(half_turn, 0, 0, half_turn, 2 * half_turn)
    step = layout.step
    columns = np.flatnonzero(np.abs(layout.polar() - np.pi / 2) <= np.radians(WIDEST_DEG) - 1e-9)
    rows, width = layout.azimuths, len(columns)
    camera = SphericalCamera(
        width, rows, step, step, (width - 1) / 2, -(layout.azimuth()[0]) / step, baseline=1.0, subpixel=EXACT
    )
    return camera, columns, layout


class Input(Protocol):
    """Input topic of the map.

    kind: its message type as `package/Name`. T_frame_sensor: (4, 4), the axes of its frames' sensor in the frame that
    its messages are in.
    """

    topic: str
    kind: str
    T_frame_sensor: Transform = np.eye(4)

    @property
    def ready(self) -> bool:
        """Whether everything but the pose is there to convert messages."""
        return True

    def is_final(self, poses: PoseBuffer, frame_id: str, stamp_ns: int) -> bool:
        """Return whether no later message can change the pose of a message."""
        return poses.is_final(frame_id, stamp_ns)

    def frame(self, data: bytes, where: PoseLookup) -> Frame | Scan | None:
        """Convert a message; the `fault` of the result says why it cannot be used. None: it is not to be mapped."""
        ...


def header(data: bytes) -> tuple[int, str]:
    """Read time in nanoseconds and frame from the header at the start of a message; raises ValueError."""
    stamp_ns, frame_id = Wire(data, cdr=True).header()
    return stamp_ns, frame_name(frame_id)


class DepthInput(Input):
    """Depth images (16UC1, 32FC1, or compressedDepth, by the topic's name) and their camera_info."""

    def __init__(self, topic: str, info: str = ""):
        self.topic, self._packed = topic, topic.endswith(COMPRESSED)
        self.kind = "sensor_msgs/CompressedImage" if self._packed else "sensor_msgs/Image"
        self.info = info or sibling(topic.removesuffix(COMPRESSED), "camera_info")
        self._camera: PinholeCamera | None = None
        self._trouble = f"{topic}: no camera_info came on {self.info}; name its topic: --depth {topic}=INFO"

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

    def frame(self, data: bytes, where: PoseLookup) -> Frame:
        """Convert a depth image."""
        blank = Frame(np.empty((0, 0), np.uint16), NO_CAMERA, NO_POSE, name=self.topic, sensor=self.topic)
        try:
            stamp_ns, frame_id = header(data)
            blank = replace(blank, stamp_ns=stamp_ns, name=_frame_title(self.topic, stamp_ns))
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
    """Point clouds for a 3-D map; see `frame_of_cloud`."""

    kind = "sensor_msgs/PointCloud2"
    T_frame_sensor = T_BODY_GRID

    def __init__(self, topic: str, step_deg: float):
        self.topic, self._step_deg = topic, step_deg

    def frame(self, data: bytes, where: PoseLookup) -> Frame:
        """Convert a cloud to a spherical depth image."""
        try:
            cloud = read_point_cloud(Wire(data, cdr=True))
            name = _frame_title(self.topic, cloud.stamp_ns)
            T_world_sensor, _, off_ns = where(frame_name(cloud.frame_id), cloud.stamp_ns)
            frame = frame_of_cloud(cloud, T_world_sensor, self._step_deg, name, self.topic)
        except (FrameRefused, ValueError) as error:
            blank = Frame(np.empty((0, 0), np.uint16), NO_CAMERA, NO_POSE, name=self.topic, sensor=self.topic)
            return replace(blank, **_fault(error, self.topic))
        return replace(frame, pose_off_ns=off_ns)


class FloorCloudInput(Input):
    """Point clouds for a floor map, reduced to what a 2-D lidar would see (`sources.cloud_scan`)."""

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


def _no_scan(topic: str, error: Exception) -> Scan:
    blank = Scan(np.empty(0, np.float32), 0.0, 0.0, 0.0, 0.0, NO_POSE, name=topic, sensor=topic)
    return replace(blank, **_fault(error, topic))


def _fault(error: Exception, name: str) -> dict[str, str]:
    if isinstance(error, FrameRefused):
        return {"fault": error.reason, "fault_detail": str(error)}
    return {"fault": "unreadable", "fault_detail": f"{name}: {error}; the message is damaged"}


def _frame_title(topic: str, stamp_ns: int) -> str:
    return f"{topic} {seconds_from_ns(stamp_ns)}"
