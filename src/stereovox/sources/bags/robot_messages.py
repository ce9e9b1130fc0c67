# SPDX-License-Identifier: Apache-2.0
"""Messages of ground robots and finished maps (OccupancyGrid, Octomap), parsed from their serialised bytes.

For both ROS 1 and ROS 2 (CDR), as in `messages`. All raise ValueError, one line, for too few bytes or impossible
values; no allocation trusts a declared length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from math import atan2, hypot, inf, isfinite, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from stereovox.depth.cloud import sweep_times
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.sources.bags.messages import Wire

OCCUPANCY_GRID, OCTOMAP = "nav_msgs/OccupancyGrid", "octomap_msgs/Octomap"
LASER_SCAN, POINT_CLOUD, ODOMETRY = "sensor_msgs/LaserScan", "sensor_msgs/PointCloud2", "nav_msgs/Odometry"
RANGE = "sensor_msgs/Range"
LIVOX = tuple(f"{package}/CustomMsg" for package in ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces"))
CLOUDS = (POINT_CLOUD, "sensor_msgs/PointCloud", *LIVOX)
TF_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
FLOATS = {7: "f4", 8: "f8"}
"""`sensor_msgs/PointField` types that can hold a coordinate."""
NUMBERS = {5: "i4", 6: "u4", **FLOATS}
POINT_TIMES = (
    "time", "t", "timestamp", "offset_time", "time_stamp", "time_offset", "time_offset_ns", "timestamp_ns", "time_us",
    "t_us", "point_time", "point_time_offset", "relative_time", "rel_time", "ts", "stamp", "timestamps",
)  # fmt: skip
"""Fields with the time of each point: Velodyne's, Ouster's, Hesai's, Livox's, Aeva's, and others'."""
MAX_FIELDS = 256
MAX_BEAMS = 100_000
LARGEST = 1e9
"""Metres: beyond any robot's reach, while products of such numbers stay finite."""


@dataclass(frozen=True, eq=False)
class LaserScan:
    """A `sensor_msgs/LaserScan`.

    ranges: (N,) float32 metres as in `frame.Scan`: NaN no reading, -inf too near, +inf nothing up to `range_max`.
    angle_min, angle_step: radians; range_min, range_max: metres. beyond: number of ranges that were discarded because
    they are beyond `range_max`.
    """

    stamp_ns: int
    frame_id: str
    angle_min: float
    angle_step: float
    range_min: float
    range_max: float
    ranges: NDArray[np.float32]
    beyond: int = 0


def read_laser_scan(wire: Wire, range_max: float = 0.0) -> LaserScan:
    """Return a `sensor_msgs/LaserScan`; `range_max`, if given, replaces the message's own, and all beyond it is far.

    Ranges become (REP 117): NaN stays NaN; below range_min, -inf and 0.0 (many drivers' "no reading") become -inf,
    which clears nothing; range_max itself and +inf become +inf, which clears up to range_max. Ranges beyond the
    message's own range_max are discarded (NaN), as LaserScan.msg asks: some drivers write range_max + 1 for "nothing
    there", others 65.533 m for "dazzled". Raises ValueError also for invalid angles and limits.
    """
    stamp_ns, frame_id = wire.header()
    angle_min, _, angle_step, _, _, range_min, declared_max = wire.numbers("f", 7)
    given, range_max = range_max, range_max or declared_max
    count = wire.number()
    if count > MAX_BEAMS:
        raise ValueError(f"a scan of {count} ranges; no lidar has that many beams")
    ranges = wire.array("f4", count).astype(np.float32, copy=False)
    if not len(ranges):
        raise ValueError("a scan with no ranges")
    if not (np.isfinite([angle_min, angle_step]).all() and 0 < abs(angle_step) <= 2 * np.pi):
        raise ValueError(f"a scan that begins at angle {angle_min:g} with steps of {angle_step:g} is invalid")
    if not (np.isfinite([range_min, range_max]).all() and 0 <= range_min < range_max):
        raise ValueError(
            f"a scan between range_min {range_min:g} and range_max {range_max:g} is invalid; give ?range_max="
        )
    with np.errstate(invalid="ignore"):
        near = (ranges < np.float32(range_min)) | (ranges <= 0)
        far = ranges >= np.float32(range_max)
        beyond = (ranges > np.float32(range_max)) & (ranges < np.inf) & (not given)
    marked = np.where(near, -np.inf, np.where(beyond, np.nan, np.where(far, np.inf, ranges))).astype(np.float32)
    return LaserScan(stamp_ns, frame_id, angle_min, angle_step, range_min, range_max, marked, int(beyond.sum()))


@dataclass(frozen=True)
class RangeReading:
    """A `sensor_msgs/Range` in frame `frame_id`, whose x axis is that of the cone.

    distance: metres as in `frame.Range`: NaN no reading, -inf too near, +inf nothing up to `range_max`. beam: full
    width of the cone in radians, 0 if it is not given. sigma: standard deviation in metres, 0 if it is not given.
    """

    stamp_ns: int
    frame_id: str
    distance: float
    beam: float
    range_min: float
    range_max: float
    sigma: float = 0.0


def read_range(wire: Wire) -> RangeReading:
    """Return a `sensor_msgs/Range`.

    As Range.msg asks, distances outside `range_min` to `range_max` are discarded (NaN); +inf is silence and -inf an
    echo that is too near. `range_max` itself is silence, too: drivers write it if nothing was heard. Sensors of a fixed
    distance (`range_min` = `range_max`) can only be silent or too near. Raises ValueError also for impossible limits.
    """
    stamp_ns, frame_id = wire.header()
    wire.number("B")  # ultrasound or infrared: both are a cone
    beam, least, most, distance = wire.numbers("f", 4)
    variance = wire.number("f") if wire.left >= 4 else 0.0  # newer than ROS 2 Humble
    is_cone = np.isfinite(beam) and 0 <= beam <= np.float32(np.pi)
    if not (is_cone and np.isfinite([least, most]).all() and 0 <= least <= most and most > 0):
        raise ValueError(
            f"a range between min_range {least:g} and max_range {most:g} with field_of_view {beam:g} is invalid"
        )
    if isfinite(distance):
        distance = inf if distance == most else distance if least <= distance < most else nan
    sigma = sqrt(variance) if 0 < variance < inf else 0.0
    return RangeReading(stamp_ns, frame_id, distance, min(beam, np.pi), least, most, sigma)


@dataclass(frozen=True, eq=False)
class PointCloud:
    """The points of a cloud message: (N, 3) float32 metres in frame `frame_id`; NaN: no point.

    times_s: (N,) float64 seconds from `stamp_ns` at which each was measured; None if the cloud has no times.
    times: how they were read, if that is unusual (`sweep_times`). fault: why they cannot be read, "" if they can.
    """

    stamp_ns: int
    frame_id: str
    points: NDArray[np.float32]
    times_s: NDArray[np.float64] | None = None
    times: str = ""
    fault: str = ""


def read_point_cloud(wire: Wire, kind: str = POINT_CLOUD, period_s: float = 0.0) -> PointCloud:
    """Return the points of a message of one of the `CLOUDS`; period_s: time from message to message, 0 if unknown.

    `PointCloud2`: fields x, y and z, at any offset, as 4 or 8 byte floats; times are the first existing field of
    `POINT_TIMES`, of a `PointCloud` such a channel, and Livox's `CustomMsg` has them in nanoseconds.
    Raises ValueError for a cloud without them, with too little data, or with overlapping points.
    """
    if kind.endswith("/CustomMsg"):
        return _livox(wire)
    return _point_cloud(wire, period_s) if kind == POINT_CLOUD else _point_cloud_1(wire, period_s)


def _point_cloud(wire: Wire, period_s: float) -> PointCloud:
    """Return a `sensor_msgs/PointCloud2`."""
    stamp_ns, frame_id = wire.header()
    height, width = wire.numbers("I", 2)
    fields = _fields(wire)
    order, point_step, row_step = ">" if wire.number("B") else "<", wire.number(), wire.number()
    data = wire.data()
    types, offsets = [], []
    for axis in "xyz":
        if axis not in fields:
            raise ValueError(f"a cloud without {axis} (it has {', '.join(fields)[:80] or 'no fields'})")
        offset, kind = fields[axis]
        if kind not in FLOATS:
            raise ValueError(f"{axis} is of type {kind}, not a float; convert the cloud to FLOAT32")
        types.append(np.dtype(f"{order}{FLOATS[kind]}"))
        offsets.append(offset)
    end = max(offset + dtype.itemsize for offset, dtype in zip(offsets, types, strict=True))
    row_step = row_step if height > 1 else width * point_step  # a single row needs none, and some drivers write 0
    if end > point_step or row_step < width * point_step:
        raise ValueError(
            f"points of {end} bytes do not fit: point_step {point_step}, row_step {row_step}, {width} wide"
        )
    _check_size(height, width, point_step, row_step, len(data))

    def column(dtype: np.dtype, offset: int) -> NDArray[np.generic]:
        if not height * width:
            return np.empty(0, dtype)
        return np.ndarray((height, width), dtype, data, offset, (row_step, point_step)).ravel()

    columns = [column(dtype, offset) for dtype, offset in zip(types, offsets, strict=True)]
    with np.errstate(over="ignore", invalid="ignore"):
        cloud = PointCloud(stamp_ns, frame_id, np.stack(columns, axis=1).astype(np.float32))
    for name in POINT_TIMES:
        offset, kind = fields.get(name, (0, 0))
        dtype = np.dtype(f"{order}{NUMBERS[kind]}") if kind in NUMBERS else None
        if dtype is not None and offset + dtype.itemsize <= point_step:
            return _timed(cloud, column(dtype, offset), period_s)
    return cloud


def _point_cloud_1(wire: Wire, period_s: float) -> PointCloud:
    """Return a `sensor_msgs/PointCloud`, the first version: points, then channels of a float for each."""
    stamp_ns, frame_id = wire.header()
    count = wire.number()
    cloud = PointCloud(stamp_ns, frame_id, wire.array("f4", 3 * count).astype(np.float32).reshape(-1, 3))
    channels = dict[str, NDArray[np.generic]]()
    for _ in range(min(wire.number(), MAX_FIELDS)):
        name = wire.text()
        channels.setdefault(name, wire.array("f4", wire.number()))
    times = next((channels[name] for name in POINT_TIMES if len(channels.get(name, ())) == count), None)
    return cloud if times is None else _timed(cloud, times, period_s)


def _livox(wire: Wire) -> PointCloud:
    """Return a `CustomMsg` of Livox's drivers: points of 19 bytes, in ROS 2 aligned to 20."""
    stamp_ns, frame_id = wire.header()
    base_ns, count, _ = wire.number("Q"), wire.number(), wire.numbers("B", 4)
    if wire.number() != count:
        raise ValueError("a cloud with two different numbers of points")
    if not count:
        return PointCloud(stamp_ns, frame_id, np.empty((0, 3), np.float32))
    record = np.dtype([("t", "u4"), ("p", "f4", 3), ("rest", "u1", 3)]).newbyteorder(wire.order)
    size = wire.point_size(record.itemsize)
    data = wire.block(size * (count - 1) + record.itemsize)
    points = np.ndarray(count, record, data, strides=(size,))
    offset_s = 1e-9 * (base_ns - stamp_ns) if abs(base_ns - stamp_ns) < 10**9 else 0.0  # or it has another clock
    return PointCloud(stamp_ns, frame_id, points["p"].astype(np.float32), 1e-9 * points["t"].astype(float) + offset_s)


def _timed(cloud: PointCloud, given: NDArray[np.generic], period_s: float) -> PointCloud:
    """Return a cloud with times of its points, or the reason why they cannot be read."""
    used = np.asarray(np.isfinite(cloud.points).all(axis=1) & cloud.points.any(axis=1), bool)
    try:
        found = sweep_times(given.astype(given.dtype.newbyteorder("=")), used, cloud.stamp_ns, period_s)
    except ValueError as error:
        return replace(cloud, fault=str(error))
    return replace(cloud, times_s=found.seconds, times=found.words)


@dataclass(frozen=True)
class StampedTransform:
    """The pose of frame `child` in frame `parent`: tx ty tz in metres, quaternion qx qy qz qw of any length.

    Names are as in tf2: without the leading slash of tf1.
    """

    stamp_ns: int
    parent: str
    child: str
    numbers: tuple[float, ...]


def read_odometry(wire: Wire) -> StampedTransform:
    """Return the pose in a `nav_msgs/Odometry`, without covariance and speed."""
    return _transform(wire)


def read_transforms(wire: Wire) -> list[StampedTransform]:
    """Return the transforms in a `tf2_msgs/TFMessage`, or in a `tf/tfMessage`, which has the same encoding."""
    return [_transform(wire) for _ in range(wire.number())]


def read_path(wire: Wire, most: int | None = None) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return times (N,) in nanoseconds and tx ty tz qx qy qz qw (N, 7) of the valid poses in a `nav_msgs/Path`.

    The frames in the headers of the poses are ignored: they equal the path's. most: largest number to read.
    """
    wire.header()
    count = wire.number()
    told = [(wire.header()[0], wire.numbers("d", 7)) for _ in range(count if most is None else min(count, most))]
    poses = [(stamp_ns, numbers) for stamp_ns, numbers in told if is_motion(numbers)]
    stamps, rows = [stamp_ns for stamp_ns, _ in poses], [numbers for _, numbers in poses]
    return np.array(stamps, np.int64), np.array(rows, float).reshape(-1, 7)


def is_motion(numbers: Sequence[float]) -> bool:
    """Return whether tx ty tz qx qy qz qw are seven numbers below `LARGEST` with a non-zero quaternion."""
    return len(numbers) == 7 and all(abs(x) < LARGEST for x in numbers) and hypot(*numbers[3:]) > 1e-6


@lru_cache(maxsize=1024)
def frame_name(frame_id: str) -> str:
    """Return a frame's name as tf2 writes it, without the leading slash of tf1."""
    return frame_id.strip().lstrip("/")


def read_occupancy_grid(wire: Wire) -> OccupancyGrid:
    """Return a `nav_msgs/OccupancyGrid`; values outside 0 to 100 are unknown, as in navigation programs.

    The message's resolution is a float32; the shortest number that rounds to it is used: 0.05 for 0.0500000007.
    """
    wire.header()
    wire.numbers("I", 2)  # time at which the map was loaded
    resolution = float(str(np.float32(wire.number("f"))))
    width, height = wire.numbers("I", 2)
    x, y, _, qx, qy, qz, qw = wire.numbers("d", 7)
    count = wire.number()
    if count != width * height or not count:
        raise ValueError(f"a grid of {width} x {height} with {count} cells")
    yaw = atan2(2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
    if not (0 < resolution < np.inf and all(map(isfinite, (x, y, yaw)))):
        raise ValueError(f"a grid with cells of {resolution:g} m at {x:g}, {y:g}")
    cells = np.frombuffer(wire.block(count), np.int8)
    known = (cells >= 0) & (cells <= 100)
    return OccupancyGrid(np.where(known, cells, np.int8(UNKNOWN)).reshape(height, width), resolution, (x, y, yaw))


@dataclass(frozen=True)
class OctomapMessage:
    """An `octomap_msgs/Octomap`: nodes as in a `.bt` (binary) or `.ot` file; resolution: side of a cell in metres."""

    frame_id: str
    binary: bool
    tree: str
    resolution: float
    data: bytes


def read_octomap_message(wire: Wire) -> OctomapMessage:
    """Return an `octomap_msgs/Octomap`."""
    _, frame_id = wire.header()
    binary, tree, resolution = bool(wire.number("B")), wire.text(), wire.number("d")
    return OctomapMessage(frame_id, binary, tree, resolution, bytes(wire.data()))


def _fields(wire: Wire) -> dict[str, tuple[int, int]]:
    """Return offset and type of each field by its name."""
    count = wire.number()
    if count > MAX_FIELDS:
        raise ValueError(f"a cloud with {count} fields")
    found = {}
    for _ in range(count):
        name, offset, kind, _ = wire.text(), wire.number(), wire.number("B"), wire.number()
        found.setdefault(name, (offset, kind))
    return found


def _check_size(height: int, width: int, point_step: int, row_step: int, size: int) -> None:
    needed = (height - 1) * row_step + width * point_step if height and width else 0
    if needed > size:
        raise ValueError(f"a cloud of {width}x{height} points needs {needed} bytes and has {size}")


def _transform(wire: Wire) -> StampedTransform:
    stamp_ns, parent = wire.header()
    return StampedTransform(stamp_ns, frame_name(parent), frame_name(wire.text()), wire.numbers("d", 7))
