# SPDX-License-Identifier: Apache-2.0
"""Recorded files for the tests: ROS 1 bags written by rosbags, ordinary ones and ones as librealsense writes them.

The RealSense ones follow librealsense's `src/media/ros/ros_writer.cpp` (file version 4): topics, message types, times
from the start of the recording, metadata, and the depth unit behind the image that its definition does not tell.
"""

from __future__ import annotations

import struct
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

STREAM = "/device_0/sensor_0/Depth_0"
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 33_333_333
WIDTH, HEIGHT = 8, 6
STREAM_INFO = "uint32 fps\nstring encoding\nbool is_recommended\n"
STREAM_INFO_MD5 = "311d7e24eac31bb87271d041bf70ff7d"  # of librealsense's text, comments and all


@cache
def store() -> Typestore:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(STREAM_INFO, "realsense_msgs/msg/StreamInfo"))
    return store


def depth(k: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    image = 1000 + 100 * k + np.arange(width * height, dtype=np.uint16).reshape(height, width)
    image[0, 0] = 0
    return image.astype(np.uint16)


def stamp(k: int) -> int:
    return START_NS + k * PERIOD_NS


class Bag:
    """Writes one bag; `add` takes a message of the typestore, or raw bytes."""

    def __init__(self, path: Path, packed: str = ""):
        self._writer = Writer(path)
        if packed:
            self._writer.set_compression(Writer.CompressionFormat[packed.upper()])
        self._writer.open()
        self._connections: dict[str, Any] = {}
        self.path = path

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def add(self, topic: str, kind: str, recorded_ns: int, message: Any, extra: bytes = b"") -> None:
        full = kind.replace("/", "/msg/")
        if topic not in self._connections:
            digest = {"msgdef": STREAM_INFO, "md5sum": STREAM_INFO_MD5} if kind.endswith("StreamInfo") else {}
            self._connections[topic] = self._writer.add_connection(topic, full, typestore=store(), **digest)
        if not isinstance(message, bytes):
            message = bytes(store().serialize_ros1(message, full))
        self._writer.write(self._connections[topic], recorded_ns, message + extra)


def message(kind: str, **fields: Any) -> Any:
    return store().types[kind.replace("/", "/msg/")](**fields)


def header(stamp_ns: int, frame_id: str = "", seq: int = 0) -> Any:
    time = message("builtin_interfaces/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return message("std_msgs/Header", seq=seq, stamp=time, frame_id=frame_id)


def image(pixels: np.ndarray, encoding: str, stamp_ns: int, frame_id: str = "", **other: Any) -> Any:
    row = pixels.dtype.itemsize * pixels.shape[1]
    fields = {"is_bigendian": 0, "step": row, "data": np.frombuffer(pixels.tobytes(), np.uint8), **other}
    height, width = pixels.shape
    return message(
        "sensor_msgs/Image", header=header(stamp_ns, frame_id), height=height, width=width, encoding=encoding, **fields
    )


def camera_info(width: int = WIDTH, height: int = HEIGHT, P: bool = True, D: tuple[float, ...] = (0.0,) * 5) -> Any:
    roi = message("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    projection = [11.0, 0, 3.6, 0, 0, 12.0, 2.6, 0, 0, 0, 1, 0] if P else [0.0] * 12
    return message(
        "sensor_msgs/CameraInfo",
        header=header(0),
        width=width,
        height=height,
        distortion_model="plumb_bob",
        D=np.array(D),
        K=np.array([10.0, 0, 3.5, 0, 10.5, 2.5, 0, 0, 1]),
        R=np.eye(3).ravel(),
        P=np.array(projection),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def vector(x: float, y: float, z: float, kind: str = "geometry_msgs/Vector3") -> Any:
    return message(kind, x=x, y=y, z=z)


def quaternion(x: float, y: float, z: float, w: float) -> Any:
    return message("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w)


def pose(numbers: Any) -> Any:
    return message(
        "geometry_msgs/Pose",
        position=vector(*numbers[:3], kind="geometry_msgs/Point"),
        orientation=quaternion(*numbers[3:]),
    )


def transform(numbers: Any) -> Any:
    return message("geometry_msgs/Transform", translation=vector(*numbers[:3]), rotation=quaternion(*numbers[3:]))


def text(value: str) -> Any:
    return message("std_msgs/String", data=value)


def pair(key: str, value: str) -> Any:
    return message("diagnostic_msgs/KeyValue", key=key, value=value)


def describe(bag: Bag, unit: float = 0.001, baseline_mm: float = 50.0) -> None:
    """What librealsense writes before the first frame."""
    bag.add("/file_version", "std_msgs/UInt32", 1, message("std_msgs/UInt32", data=4))
    for key, value in (("Name", "Intel RealSense D435"), ("Serial Number", "042"), ("Product Id", "0B07")):
        bag.add("/device_0/info", "diagnostic_msgs/KeyValue", 1, pair(key, value))
    bag.add("/device_0/sensor_0/info", "diagnostic_msgs/KeyValue", 1, pair("Name", "Stereo Module"))
    info = message("realsense_msgs/StreamInfo", fps=30, encoding="mono16", is_recommended=True)
    bag.add(f"{STREAM}/info", "realsense_msgs/StreamInfo", 1, info)
    bag.add(f"{STREAM}/info/camera_info", "sensor_msgs/CameraInfo", 1, camera_info(P=False))
    for name, value in (("Depth Units", unit), ("Stereo Baseline", baseline_mm)):
        option = f"/device_0/sensor_0/option/{name}"
        bag.add(f"{option}/value", "std_msgs/Float32", 1, message("std_msgs/Float32", data=value))
        bag.add(f"{option}/description", "std_msgs/String", 1, text("what it is"))


def add_depth(bag: Bag, k: int, unit: float | None = 0.001, **other: Any) -> None:
    """One depth frame: image with the unit behind it (None: before librealsense 2.40), then its metadata."""
    recorded_ns = 20_000_000 + k * PERIOD_NS
    taken = image(depth(k), "mono16", stamp(k), "" if unit is None else "1", **other)
    bag.add(
        f"{STREAM}/image/data",
        "sensor_msgs/Image",
        recorded_ns,
        taken,
        b"" if unit is None else struct.pack("<f", unit),
    )
    for key, value in (("system_time", "0.0"), ("timestamp_domain", "Global Time"), ("Frame Counter", str(k))):
        bag.add(f"{STREAM}/image/metadata", "diagnostic_msgs/KeyValue", recorded_ns, pair(key, value))
    if k == 0:
        bag.add(f"{STREAM}/tf/0", "geometry_msgs/Transform", 1, transform([0, 0, 0, 0, 0, 0, 1]))


def realsense_bag(path: Path, count: int = 4, packed: str = "", unit: float | None = 0.001) -> Path:
    with Bag(path, packed) as bag:
        describe(bag)
        for k in range(count):
            add_depth(bag, k, unit)
    return path


T265 = "/device_0/sensor_0/Pose_0"


def add_t265(bag: Bag, recorded_ns: int, stamp_ns: int, numbers: Any, confidence: int = 3) -> None:
    """One pose frame: three messages, and its time and confidence as metadata, in milliseconds."""
    nothing = vector(0.0, 0.0, 0.0)
    bag.add(f"{T265}/pose/transform/data", "geometry_msgs/Transform", recorded_ns, transform(numbers))
    for name, kind in (("accel", "geometry_msgs/Accel"), ("twist", "geometry_msgs/Twist")):
        bag.add(f"{T265}/pose/{name}/data", kind, recorded_ns, message(kind, linear=nothing, angular=nothing))
    milliseconds = f"{stamp_ns // 10**6}.{stamp_ns % 10**6:06d}"
    for key, value in (
        ("Tracker Confidence", str(confidence)),
        ("Mapper Confidence", "2"),
        ("frame_timestamp", milliseconds),
        ("Frame number", "1"),
    ):
        bag.add(f"{T265}/pose/metadata", "diagnostic_msgs/KeyValue", recorded_ns, pair(key, value))


def ros_bag(path: Path, count: int = 3, packed: str = "", topic: str = "/camera/depth/image_rect_raw") -> Path:
    """An ordinary bag with 16UC1 images, camera_info next to them, and something that is none of our business."""
    with Bag(path, packed) as bag:
        bag.add("/chatter", "std_msgs/String", START_NS, text("hello"))
        for k in range(count):
            bag.add(topic, "sensor_msgs/Image", stamp(k) + 5_000_000, image(depth(k), "16UC1", stamp(k), "/optical"))
            info = camera_info()
            bag.add(f"{topic.rpartition('/')[0]}/camera_info", "sensor_msgs/CameraInfo", stamp(k), info)
    return path
