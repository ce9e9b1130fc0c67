# SPDX-License-Identifier: Apache-2.0
"""Bags of ground robots for the tests, ROS 1 and ROS 2, written by rosbags."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from stereovox.geometry.se3 import Transform
from stereovox.sources.bags.messages import Wire

START_NS = 1_600_000_000_000_000_000
MS = 1_000_000
TF = "tf2_msgs/TFMessage"


@cache
def store(ros: int) -> Typestore:
    made = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    if ros == 1:
        for kind in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
            made.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", kind))
    return made


class Messages:
    """Messages of one ROS."""

    def __init__(self, ros: int):
        self.ros, self._store = ros, store(ros)

    def make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind.replace("/", "/msg/")](**fields)

    def raw(self, kind: str, message: Any, little_endian: bool = True) -> bytes:
        full = kind.replace("/", "/msg/")
        if self.ros == 1:
            return bytes(self._store.serialize_ros1(message, full))
        return bytes(self._store.serialize_cdr(message, full, little_endian=little_endian))

    def wire(self, kind: str, message: Any, little_endian: bool = True) -> Wire:
        return Wire(self.raw(kind, message, little_endian), cdr=self.ros == 2)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        time = self.make("builtin_interfaces/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        seq = {"seq": 0} if self.ros == 1 else {}
        return self.make("std_msgs/Header", **seq, stamp=time, frame_id=frame_id)

    def scan(self, stamp_ns: int, ranges: Any, frame_id: str = "laser", **other: Any) -> Any:
        fields = {
            "angle_min": -1.0, "angle_max": 1.0, "angle_increment": 0.5, "time_increment": 0.0, "scan_time": 0.1,
            "range_min": 0.1, "range_max": 5.6, "intensities": np.empty(0, np.float32),
        } | other  # fmt: skip
        head = self.header(stamp_ns, frame_id)
        return self.make("sensor_msgs/LaserScan", header=head, ranges=np.asarray(ranges, np.float32), **fields)

    def cloud(self, stamp_ns: int, points: Any, frame_id: str = "lidar", **other: Any) -> Any:
        data = np.ascontiguousarray(points, np.float32)
        fields = [self.field(name, 4 * k, 7) for k, name in enumerate("xyz")]
        told = {
            "height": 1, "width": len(data), "fields": fields, "is_bigendian": False, "point_step": 12,
            "row_step": 12 * len(data), "data": np.frombuffer(data.tobytes(), np.uint8), "is_dense": False,
        } | other  # fmt: skip
        return self.make("sensor_msgs/PointCloud2", header=self.header(stamp_ns, frame_id), **told)

    def field(self, name: str, offset: int, kind: int) -> Any:
        return self.make("sensor_msgs/PointField", name=name, offset=offset, datatype=kind, count=1)

    def _vector(self, kind: str, numbers: Any) -> Any:
        return self.make(kind, **dict(zip("xyzw", map(float, numbers), strict=False)))

    def path(self, frame_id: str, *poses: tuple[int, Any]) -> Any:
        return self.make(
            "nav_msgs/Path",
            header=self.header(0, frame_id),
            poses=[
                self.make("geometry_msgs/PoseStamped", header=self.header(stamp_ns, ""), pose=self._pose(numbers))
                for stamp_ns, numbers in poses
            ],
        )

    def _pose(self, numbers: Any) -> Any:
        return self.make(
            "geometry_msgs/Pose",
            position=self._vector("geometry_msgs/Point", numbers[:3]),
            orientation=self._vector("geometry_msgs/Quaternion", numbers[3:]),
        )

    def odometry(self, stamp_ns: int, numbers: Any, parent: str = "odom", child: str = "base_link") -> Any:
        zero, nothing = self._vector("geometry_msgs/Vector3", (0, 0, 0)), np.zeros(36)
        pose = self._pose(numbers)
        twist = self.make("geometry_msgs/Twist", linear=zero, angular=zero)
        return self.make(
            "nav_msgs/Odometry",
            header=self.header(stamp_ns, parent),
            child_frame_id=child,
            pose=self.make("geometry_msgs/PoseWithCovariance", pose=pose, covariance=nothing),
            twist=self.make("geometry_msgs/TwistWithCovariance", twist=twist, covariance=nothing),
        )

    def transforms(self, *edges: tuple[int, str, str, Any], kind: str = TF) -> Any:
        """Edges are (stamp_ns, parent, child, seven numbers)."""
        stamped = [
            self.make(
                "geometry_msgs/TransformStamped",
                header=self.header(stamp_ns, parent),
                child_frame_id=child,
                transform=self.make(
                    "geometry_msgs/Transform",
                    translation=self._vector("geometry_msgs/Vector3", numbers[:3]),
                    rotation=self._vector("geometry_msgs/Quaternion", numbers[3:]),
                ),
            )
            for stamp_ns, parent, child, numbers in edges
        ]
        return self.make(kind, transforms=stamped)

    def image(self, stamp_ns: int, pixels: np.ndarray, frame_id: str) -> Any:
        height, width = pixels.shape
        told = {"height": height, "width": width, "encoding": "16UC1", "is_bigendian": 0, "step": 2 * width}
        data = np.frombuffer(pixels.astype("<u2").tobytes(), np.uint8)
        return self.make("sensor_msgs/Image", header=self.header(stamp_ns, frame_id), **told, data=data)

    def camera_info(self, stamp_ns: int, width: int, height: int) -> Any:
        roi = self.make("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        K, P = [10.0, 0, 3.5, 0, 10.5, 2.5, 0, 0, 1], [0.0] * 12
        names = ("D", "K", "R", "P") if self.ros == 1 else ("d", "k", "r", "p")
        arrays = dict(zip(names, map(np.array, ([0.0] * 5, K, np.eye(3).ravel(), P)), strict=True))
        other = {"distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0, "roi": roi, **arrays}
        head = self.header(stamp_ns, "optical")
        return self.make("sensor_msgs/CameraInfo", header=head, width=width, height=height, **other)


class RobotBagMaker(Messages):
    """Writes one bag; `path`: `.bag` for ROS 1, `.db3` for ROS 2 (in a folder of the same name without ending)."""

    def __init__(self, path: Path):
        super().__init__(1 if path.suffix == ".bag" else 2)
        self._folder = path.with_suffix("")
        self.path = path if self.ros == 1 else self._folder / f"{self._folder.name}.db3"
        if self.ros == 1:
            self._writer: Any = Writer1(path)
        else:
            self._writer = Writer2(self._folder, version=9, storage_plugin=StoragePlugin.SQLITE3)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> RobotBagMaker:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def add(self, topic: str, kind: str, recorded_ns: int, message: Any) -> None:
        """`message` of this typestore, or raw bytes."""
        if topic not in self._connections:
            full = kind.replace("/", "/msg/")
            self._connections[topic] = self._writer.add_connection(topic, full, typestore=self._store)
        raw = message if isinstance(message, bytes) else self.raw(kind, message)
        self._writer.write(self._connections[topic], recorded_ns, raw)

    def tf(self, stamp_ns: int, parent: str, child: str, numbers: Any, topic: str = "/tf") -> None:
        self.add(topic, TF, stamp_ns, self.transforms((stamp_ns, parent, child, numbers)))

    def scans(self, count: int, topic: str = "/scan", frame_id: str = "laser", period_ns: int = 100 * MS) -> None:
        for k in range(count):
            stamp_ns = START_NS + k * period_ns
            message = self.scan(stamp_ns, [1.0 + k, 2, 3], frame_id)
            self.add(topic, "sensor_msgs/LaserScan", stamp_ns + 3 * MS, message)

    def fix(
        self, stamp_ns: int, latitude: float, longitude: float, height: float, status: int = 0, topic: str = "/fix"
    ) -> None:
        message = self.make(
            "sensor_msgs/NavSatFix", header=self.header(stamp_ns, "gps"),
            status=self.make("sensor_msgs/NavSatStatus", status=status, service=1),
            latitude=latitude, longitude=longitude, altitude=height,
            position_covariance=np.zeros(9), position_covariance_type=0,
        )  # fmt: skip
        self.add(topic, "sensor_msgs/NavSatFix", stamp_ns, message)

    def depth(self, count: int, frame_id: str = "optical", info: bool = True, topic: str = "/camera/depth") -> None:
        for k in range(count):
            stamp_ns = START_NS + k * 100 * MS
            pixels = 1000 + 100 * k + np.arange(48, dtype=np.uint16).reshape(6, 8)
            self.add(f"{topic}/image", "sensor_msgs/Image", stamp_ns, self.image(stamp_ns, pixels, frame_id))
            if info:
                self.add(f"{topic}/camera_info", "sensor_msgs/CameraInfo", stamp_ns, self.camera_info(stamp_ns, 8, 6))


def planar_numbers(x: float, y: float, yaw: float, z: float = 0.0) -> list[float]:
    return [x, y, z, 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]


def planar_motion(x: float, y: float, yaw: float, z: float = 0.0) -> Transform:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T
