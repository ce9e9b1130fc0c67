# SPDX-License-Identifier: Apache-2.0
"""Messages of robots, as rosbags serialises them for ROS 1 and ROS 2, and such that lie."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from made_robot_bags import START_NS, TF, Messages

from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.robot_messages import (
    read_laser_scan,
    read_odometry,
    read_path,
    read_point_cloud,
    read_transforms,
)

INF, NAN = np.inf, np.nan
SCAN, CLOUD, ODOMETRY = "sensor_msgs/LaserScan", "sensor_msgs/PointCloud2", "nav_msgs/Odometry"
PATH = "nav_msgs/Path"
WIRES = pytest.mark.parametrize(("ros", "little"), [(1, True), (2, True), (2, False)])
STAMP = START_NS + 123_456_789


@WIRES
def test_a_scan_means_what_rep_117_says(ros, little):
    told = [1.5, NAN, INF, -INF, 0.0, 0.05, 0.1, 5.6, 6.6, 5.59]
    made = Messages(ros)
    read = read_laser_scan(made.wire(SCAN, made.scan(STAMP, told), little))
    assert (read.stamp_ns, read.frame_id) == (STAMP, "laser")
    assert (read.angle_min, read.angle_step) == (-1, 0.5)
    assert (read.range_min, read.range_max) == (np.float32(0.1), np.float32(5.6))
    wanted = [1.5, NAN, INF, -INF, -INF, -INF, 0.1, INF, NAN, 5.59]
    np.testing.assert_array_equal(read.ranges, np.array(wanted, np.float32))
    assert (read.ranges.dtype, read.beyond) == (np.float32, 1)


def test_zero_is_no_reading_even_where_the_scan_begins_at_zero():
    made = Messages(1)
    read = read_laser_scan(made.wire(SCAN, made.scan(STAMP, [0.0, 0.001], range_min=0.0)))
    np.testing.assert_array_equal(read.ranges, np.array([-INF, 0.001], np.float32))


def test_another_range_max_counts_in_place_of_the_told_one():
    made = Messages(1)
    wire = made.wire(SCAN, made.scan(STAMP, [3.0, 5.0, 9.0], range_max=INF))
    np.testing.assert_array_equal(read_laser_scan(wire, 4.0).ranges, np.array([3, INF, INF], np.float32))
    read = read_laser_scan(made.wire(SCAN, made.scan(STAMP, [3.0, 5.6, 65.533])), 5.6)
    np.testing.assert_array_equal(read.ranges, np.array([3, INF, INF], np.float32))
    assert read.beyond == 0


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"range_max": INF}, "range_max="),
        ({"range_max": NAN}, "range_max="),
        ({"range_max": 0.1}, "range_max"),
        ({"range_min": -1.0}, "range_min"),
        ({"angle_increment": 0.0}, "steps of 0"),
        ({"angle_increment": NAN}, "steps of nan"),
        ({"angle_min": INF}, "angle inf"),
    ],
)
def test_scans_that_make_no_sense(other, said):
    made = Messages(2)
    with pytest.raises(ValueError, match=said):
        read_laser_scan(made.wire(SCAN, made.scan(STAMP, [1.0], **other)))


def test_a_scan_without_ranges_is_none():
    made = Messages(1)
    with pytest.raises(ValueError, match="no ranges"):
        read_laser_scan(made.wire(SCAN, made.scan(STAMP, [])))


def stored(dtype: np.dtype, height: int, width: int, row_padding: int) -> tuple[np.ndarray, np.ndarray]:
    """A structured cloud, and its bytes with padding behind each row."""
    points = np.zeros((height, width), dtype)
    values = np.arange(height * width, dtype=float).reshape(height, width)
    for k, axis in enumerate("xyz"):
        points[axis] = values * 0.25 + 100 * k
    rows = [row.tobytes() + b"\xff" * row_padding for row in points]
    return points, np.frombuffer(b"".join(rows), np.uint8)


@WIRES
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize(("height", "width", "padding"), [(1, 7, 0), (3, 2, 0), (3, 2, 5)])
def test_a_cloud_of_any_layout(ros, little, order, kind, height, width, padding):
    made = Messages(ros)
    offsets = {"z": 1, "x": 12, "y": 25}
    layout = {"names": [*offsets], "formats": [f"{order}{kind}"] * 3, "offsets": [*offsets.values()], "itemsize": 37}
    points, data = stored(np.dtype(layout), height, width, padding)
    datatype = {"f4": 7, "f8": 8}[kind]
    fields = [made.field("rgb", 0, 2), *(made.field(name, at, datatype) for name, at in offsets.items())]
    message = made.cloud(
        STAMP, np.empty((0, 3)), height=height, width=width, fields=fields, is_bigendian=order == ">",
        point_step=37, row_step=37 * width + padding, data=data,
    )  # fmt: skip
    read = read_point_cloud(made.wire(CLOUD, message, little))
    assert (read.stamp_ns, read.frame_id, read.points.dtype) == (STAMP, "lidar", np.float32)
    wanted = [[points[axis][r, c] for axis in "xyz"] for r in range(height) for c in range(width)]
    np.testing.assert_array_equal(read.points, np.array(wanted, np.float32))


def test_an_empty_cloud_and_one_row_without_row_step():
    made = Messages(2)
    assert read_point_cloud(made.wire(CLOUD, made.cloud(STAMP, np.empty((0, 3))))).points.shape == (0, 3)
    points = np.arange(6.0).reshape(2, 3)
    read = read_point_cloud(made.wire(CLOUD, made.cloud(STAMP, points, row_step=0)))
    np.testing.assert_array_equal(read.points, points)


def short(made: Messages, **other: object):
    return made.wire(CLOUD, made.cloud(STAMP, np.ones((4, 3)), **other))


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"width": 5, "row_step": 60}, "needs 60 bytes and has 48"),
        ({"width": 2**31, "height": 2, "row_step": 0}, "do not fit"),  # the product is 2^32: 0 in 32 bits
        ({"width": 2**31, "height": 1}, "needs"),
        ({"height": 2**32 - 1, "width": 4}, "needs"),
        ({"point_step": 8}, "do not fit"),
        ({"point_step": 0}, "do not fit"),
        ({"height": 2, "width": 2, "row_step": 12}, "do not fit"),
        ({"height": 2, "width": 2, "row_step": 2**32 - 1}, "needs"),
    ],
)
def test_clouds_whose_size_lies(ros, other, said):
    with pytest.raises(ValueError, match=said):
        read_point_cloud(short(Messages(ros), **other))


def test_clouds_without_coordinates():
    made = Messages(1)
    with pytest.raises(ValueError, match=r"without z \(it has x, y\)"):
        read_point_cloud(short(made, fields=[made.field("x", 0, 7), made.field("y", 4, 7)]))
    with pytest.raises(ValueError, match="no fields"):
        read_point_cloud(short(made, fields=[]))
    with pytest.raises(ValueError, match="x is of type 5, not a float"):
        read_point_cloud(short(made, fields=[made.field(name, 0, 5) for name in "xyz"]))


@WIRES
def test_odometry_and_transforms(ros, little):
    made, numbers = Messages(ros), (1.0, -2.0, 3.0, 0.1, -0.2, 0.3, 0.9)
    read = read_odometry(made.wire(ODOMETRY, made.odometry(STAMP, numbers, "/odom", "base_link"), little))
    assert (read.stamp_ns, read.parent, read.child, read.numbers) == (STAMP, "odom", "base_link", numbers)
    other = tuple(2 * x for x in numbers)
    message = made.transforms((STAMP, "/map", "/odom", numbers), (STAMP + 5, "odom", "a_frame", other))
    first, second = read_transforms(made.wire(TF, message, little))
    assert (first.stamp_ns, first.parent, first.child, first.numbers) == (STAMP, "map", "odom", numbers)
    assert (second.stamp_ns, second.parent, second.child, second.numbers) == (STAMP + 5, "odom", "a_frame", other)


@WIRES
def test_a_path_and_its_poses_that_are_none(ros, little):
    made, numbers = Messages(ros), (1.0, -2.0, 3.0, 0.1, -0.2, 0.3, 0.9)
    told = made.path("map", (STAMP, numbers), (STAMP + 5, [np.nan] * 7), (STAMP + 9, [0.0] * 7), (STAMP + 7, numbers))
    stamps, rows = read_path(made.wire(PATH, told, little))
    assert stamps.tolist() == [STAMP, STAMP + 7]
    np.testing.assert_array_equal(rows, [numbers, numbers])
    stamps, rows = read_path(made.wire(PATH, made.path("map"), little))
    assert (stamps.shape, rows.shape) == ((0,), (0, 7))


CASES = {
    SCAN: (read_laser_scan, lambda made: made.scan(STAMP, [1.0, 2.0, 3.0])),
    CLOUD: (read_point_cloud, lambda made: made.cloud(STAMP, np.ones((3, 3)))),
    ODOMETRY: (read_odometry, lambda made: made.odometry(STAMP, [0, 0, 0, 0, 0, 0, 1])),
    PATH: (read_path, lambda made: made.path("a", (STAMP, [0, 0, 0, 0, 0, 0, 1]))),
    TF: (read_transforms, lambda made: made.transforms((STAMP, "a", "b", [0, 0, 0, 0, 0, 0, 1]))),
}
NEEDED = {SCAN: 4, CLOUD: 1, ODOMETRY: 36 * 8 * 2 + 6 * 8, PATH: 0, TF: 0}
"""Bytes behind what is read: intensities, is_dense, covariances and speeds."""


@pytest.mark.parametrize("ros", [1, 2])
@pytest.mark.parametrize("kind", CASES)
def test_every_way_to_cut_and_every_length_that_lies(ros, kind):
    read, make = CASES[kind]
    raw = Messages(ros).raw(kind, make(Messages(ros)))
    read(Wire(raw[: len(raw) - NEEDED[kind]], cdr=ros == 2))
    for length in range(4, len(raw) - NEEDED[kind] - 3):  # CDR may pad its end
        with pytest.raises(ValueError):  # noqa: PT011 - the text differs from byte to byte
            read(Wire(raw[:length], cdr=ros == 2))
    said = []
    for at in range(4, len(raw) - 4):
        lying = bytearray(raw)
        struct.pack_into("<I", lying, at, 0x7FFFFFFF)
        try:
            read(Wire(lying, cdr=ros == 2))
        except ValueError as error:
            said.append(str(error))
    assert said
    assert not any("\n" in text for text in said)
