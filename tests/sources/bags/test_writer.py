# SPDX-License-Identifier: Apache-2.0
"""Bags that are written: what rosbags' own reader finds in them, value for value, and all or nothing."""

from __future__ import annotations

import errno
import os
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from scipy.spatial.transform import Rotation

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import MissingExtra, SourceError
from stereovox.frame import Frame, Scan
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.opening import open_source
from stereovox.sources.bags.writer import BagWriter

NAMES = ["walk.bag", "walk.db3", "walk.mcap", "walk", "walk.v2.mcap"]
S = 1_700_000_000_123_456_789
CAMERA = PinholeCamera(8, 6, 10.0, 10.5, 3.4, 2.6)
RANGES = np.array([0.5, np.nan, -np.inf, np.inf, 5.25, 1 / 3], np.float32)
CELLS = np.random.default_rng(4).integers(-1, 101, (30, 50)).astype(np.int8)
GRID = OccupancyGrid(CELLS, 0.02, (-1.5, 2.25, 0.5))


def moved(seed: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return T


def scan(stamp_ns: int = S, **other: Any) -> Scan:
    return Scan(RANGES, -2.0, 0.75, 0.06, 5.6, np.eye(4), stamp_ns=stamp_ns, **other)


def frame(depth: np.ndarray, stamp_ns: int = S, scale: float = 0.001, **other: Any) -> Frame:
    return Frame(depth, CAMERA, np.eye(4), stamp_ns, scale, **other)


def whole(k: int = 0) -> np.ndarray:
    depth = (1000 + 100 * k + np.arange(48).reshape(6, 8)).astype(np.uint16)
    depth[0, 0] = 0
    return depth


def found(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Every message in a bag by topic, with the time at which it was recorded, as rosbags reads it."""
    messages: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, time, data in reader.messages():
            messages.setdefault(connection.topic, []).append((time, reader.deserialize(data, connection.msgtype)))
    return messages


def time_of(header: Any) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def only(path: Path, topic: str) -> Any:
    ((_, message),) = found(path)[topic]
    return message


def within(path: Path, *steps: Callable[[BagWriter], object]) -> None:
    with BagWriter(path) as bag:
        for step in steps:
            step(bag)


def upright(yaw: float) -> np.ndarray:
    return Rotation.from_euler("z", yaw).as_matrix()


def turn(q: Any) -> np.ndarray:
    return Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("name", NAMES)
def test_scans_come_back_as_they_are(tmp_path, name, packed):
    with BagWriter(tmp_path / name, packed=packed) as bag:
        bag.scan(scan())
        bag.scan(scan(S + 7), "/front/scan", "front")
    told = found(tmp_path / name)
    assert {topic: [time for time, _ in told[topic]] for topic in told} == {"/scan": [S], "/front/scan": [S + 7]}
    message = told["/scan"][0][1]
    assert (time_of(message.header), message.header.frame_id) == (S, "laser")
    np.testing.assert_array_equal(message.ranges, RANGES)
    numbers = message.angle_min, message.angle_max, message.angle_increment, message.range_min, message.range_max
    assert numbers == pytest.approx((-2.0, 1.75, 0.75, 0.06, 5.6), rel=1e-6)
    assert told["/front/scan"][0][1].header.frame_id == "front"
    assert os.listdir(tmp_path) == [name]


def test_a_name_of_the_greatest_length_is_written(tmp_path):
    name = "字" * 83 + ".mcap"  # 254 bytes
    with BagWriter(tmp_path / name) as bag:
        bag.scan(scan())
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("name", NAMES)
def test_depth_with_its_camera(tmp_path, name):
    floats = (whole(2) * 0.00123).astype(np.float32)
    floats[0, :2] = np.nan, np.inf
    with BagWriter(tmp_path / name) as bag:
        bag.depth(frame(whole()))
        bag.depth(frame(floats, S + 1, 1.0), "/sim/depth", "eye")
        bag.depth(frame(whole(1), S + 2), "/small/image", compressed=True)
    told = found(tmp_path / name)
    plain = told["/camera/depth/image_raw"][0][1]
    assert (plain.encoding, plain.height, plain.width, plain.step, plain.is_bigendian) == ("16UC1", 6, 8, 16, 0)
    assert (time_of(plain.header), plain.header.frame_id) == (S, "camera_depth_optical_frame")
    np.testing.assert_array_equal(plain.data.view("<u2").reshape(6, 8), whole())
    metric = told["/sim/depth"][0][1]
    assert (metric.encoding, metric.step, metric.header.frame_id) == ("32FC1", 32, "eye")
    np.testing.assert_array_equal(metric.data.view("<f4").reshape(6, 8), floats)
    small = told["/small/image/compressedDepth"][0][1]
    assert small.format == "16UC1; compressedDepth png"
    np.testing.assert_array_equal(cv2.imdecode(small.data[12:], cv2.IMREAD_UNCHANGED), whole(1))
    for topic, stamp_ns in (
        ("/camera/depth/camera_info", S),
        ("/sim/camera_info", S + 1),
        ("/small/camera_info", S + 2),
    ):
        info = told[topic][0][1]
        assert (time_of(info.header), info.width, info.height, info.distortion_model) == (stamp_ns, 8, 6, "plumb_bob")
        K = [[10, 0, 3.4], [0, 10.5, 2.6], [0, 0, 1]]
        named = {key.upper(): getattr(info, key) for key in ("dkrp" if hasattr(info, "k") else "DKRP")}
        np.testing.assert_array_equal(named["K"], np.ravel(K))
        np.testing.assert_array_equal(named["P"], np.column_stack([K, np.zeros(3)]).ravel())
        np.testing.assert_array_equal(named["R"], np.eye(3).ravel())
        assert not np.any(named["D"])


@pytest.mark.parametrize("name", NAMES)
def test_our_own_reader_gives_the_frames_back(tmp_path, name):
    with BagWriter(tmp_path / name) as bag:
        for k in range(4):
            bag.depth(frame(whole(k), S + k * 10**8), compressed=name.endswith(".db3"))
    source = open_source(f"{tmp_path / name}?pose=fixed")
    assert (len(source), source.camera, source.notes) == (4, CAMERA, ())
    for k in (3, 0, 2, 1):
        np.testing.assert_array_equal(source.frame(k).depth, whole(k))
        assert (source.frame(k).stamp_ns, source.frame(k).fault) == (S + k * 10**8, None)


@pytest.mark.parametrize("name", NAMES)
def test_odometry_is_also_a_transform(tmp_path, name):
    with BagWriter(tmp_path / name) as bag:
        bag.odometry(S, (1.5, -2.0, 2.5))
        bag.odometry(S + 5, (0, 0, -3.0), "/wheel", "wheels", "robot")
    told = found(tmp_path / name)
    message = told["/odom"][0][1]
    assert (time_of(message.header), message.header.frame_id, message.child_frame_id) == (S, "odom", "base_link")
    at = message.pose.pose.position
    assert (at.x, at.y, at.z) == (1.5, -2.0, 0.0)
    np.testing.assert_allclose(turn(message.pose.pose.orientation), upright(2.5), atol=1e-12)
    assert told["/wheel"][0][1].child_frame_id == "robot"
    (first_ns, first), (_, second) = told["/tf"]
    (edge,) = first.transforms
    assert (first_ns, time_of(edge.header), edge.header.frame_id, edge.child_frame_id) == (S, S, "odom", "base_link")
    assert (edge.transform.translation.x, edge.transform.translation.y) == (1.5, -2.0)
    np.testing.assert_allclose(turn(edge.transform.rotation), upright(2.5), atol=1e-12)
    assert (second.transforms[0].header.frame_id, second.transforms[0].child_frame_id) == ("wheels", "robot")


@pytest.mark.parametrize("seed", range(6))
def test_any_motion_comes_back(tmp_path, seed):
    half_turn = np.diag([1.0, -1.0, -1.0, 1.0])
    T = {4: np.eye(4), 5: half_turn}.get(seed, moved(seed))
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.transform(S, "map", "odom", T)
    (edge,) = only(tmp_path / "a.mcap", "/tf").transforms
    shift = edge.transform.translation
    np.testing.assert_array_equal([shift.x, shift.y, shift.z], T[:3, 3])
    np.testing.assert_allclose(turn(edge.transform.rotation), T[:3, :3], atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_fixed_frames_stand_in_one_latched_message(tmp_path, name):
    with BagWriter(tmp_path / name) as bag:
        bag.fixed("base_link", "laser", moved(1))
        bag.fixed("base_link", "camera", moved(2))
        bag.scan(scan())
        bag.scan(scan(S + 9))
    ((stamp_ns, message),) = found(tmp_path / name)["/tf_static"]
    assert stamp_ns == S  # not 0: players would wait half a century
    edges = {edge.child_frame_id: edge for edge in message.transforms}
    assert sorted(edges) == ["camera", "laser"]
    np.testing.assert_allclose(turn(edges["camera"].transform.rotation), moved(2)[:3, :3], atol=1e-9)
    assert edges["laser"].header.frame_id == "base_link"
    assert latched(tmp_path / name) == {"/tf_static": True, "/scan": False}


def latched(path: Path) -> dict[str, bool]:
    with AnyReader([path]) as reader:
        told = {connection.topic: connection.ext for connection in reader.connections}
    keep = QosDurability.TRANSIENT_LOCAL
    if path.suffix == ".bag":
        return {topic: str(ext.latching) == "1" for topic, ext in told.items()}
    return {topic: [qos.durability for qos in ext.offered_qos_profiles] == [keep] for topic, ext in told.items()}


def test_later_fixed_frames_repeat_the_earlier_ones(tmp_path):
    with BagWriter(tmp_path / "a.bag") as bag:
        bag.fixed("base", "laser", moved(1))
        bag.scan(scan())
        bag.fixed("base", "camera", moved(2))
    told = found(tmp_path / "a.bag")["/tf_static"]
    assert [[edge.child_frame_id for edge in message.transforms] for _, message in told] == [
        ["laser"],
        ["laser", "camera"],
    ]


@pytest.mark.parametrize("name", NAMES)
def test_poses_with_covariance(tmp_path, name):
    small, large = np.arange(1.0, 10).reshape(3, 3), np.arange(36.0).reshape(6, 6)
    with BagWriter(tmp_path / name) as bag:
        for k, covariance in enumerate((small, large, None)):
            bag.pose(S + k, (1.0, 2.0, -0.5), covariance)
    messages = [message for _, message in found(tmp_path / name)["/amcl_pose"]]
    assert (time_of(messages[1].header), messages[0].header.frame_id) == (S + 1, "map")
    np.testing.assert_allclose(turn(messages[0].pose.pose.orientation), upright(-0.5), atol=1e-12)
    covered = messages[0].pose.covariance.reshape(6, 6)
    assert (covered[0, 1], covered[1, 5], covered[5, 0], covered[5, 5]) == (2, 6, 7, 9)
    assert np.count_nonzero(covered) == 9
    np.testing.assert_array_equal(messages[1].pose.covariance, large.ravel())
    assert not messages[2].pose.covariance.any()


@pytest.mark.parametrize("name", NAMES)
def test_maps(tmp_path, name):
    with BagWriter(tmp_path / name) as bag:
        bag.occupancy(S, GRID)
    message = only(tmp_path / name, "/map_mapping")
    assert (message.info.width, message.info.height, message.info.resolution) == (50, 30, pytest.approx(0.02))
    np.testing.assert_array_equal(np.asarray(message.data, np.int8).reshape(30, 50), CELLS)
    origin = message.info.origin
    assert (origin.position.x, origin.position.y, origin.position.z) == (-1.5, 2.25, 0)
    np.testing.assert_allclose(turn(origin.orientation), upright(0.5), atol=1e-12)
    assert latched(tmp_path / name) == {"/map_mapping": True}


def test_a_map_that_is_a_view_of_another(tmp_path):
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.occupancy(S, OccupancyGrid(CELLS[::2, 10:20], 0.1))
    message = only(tmp_path / "a.mcap", "/map_mapping")
    np.testing.assert_array_equal(np.asarray(message.data).reshape(15, 10), CELLS[::2, 10:20])


@pytest.mark.parametrize(
    ("depth", "scale", "expected"),
    [
        (np.array([1, 65535, 65534, 0], np.uint16), 0.001, [1, 65535, 65534, 0]),  # millimetres stay as they are
        (np.array([1, 65535, 60000, 0], np.uint16), 0.002, [2, 0, 0, 0]),
        (np.array([1, 65535, 60000, 4], np.uint16), 0.00025, [0, 0, 15000, 1]),
        (np.array([-1, np.nan, np.inf, 1.2346], np.float32), 1.0, [0, 0, 0, 1235]),
        (np.array([65.535, 65.534, 1e-4, 2], np.float64), 1.0, [0, 65534, 0, 2000]),
    ],
)
def test_millimetres(tmp_path, depth, scale, expected):
    camera = PinholeCamera(4, 1, 4.0, 4.0, 1.5, 0.0)
    with BagWriter(tmp_path / "a.bag") as bag:
        bag.depth(Frame(depth.reshape(1, 4), camera, np.eye(4), S, scale), "/d/image", compressed=True)
    small = only(tmp_path / "a.bag", "/d/image/compressedDepth")
    np.testing.assert_array_equal(cv2.imdecode(small.data[12:], cv2.IMREAD_UNCHANGED), [expected])


@pytest.mark.parametrize("name", NAMES)
def test_what_goes_wrong_leaves_nothing(tmp_path, name):
    def fail(bag: BagWriter) -> None:
        bag.scan(scan())
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        within(tmp_path / name, fail)
    assert os.listdir(tmp_path) == []


def write_too_early(bag: BagWriter) -> None:
    bag.scan(scan(-1))


def fill_up(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("name", ["walk.bag", "walk.db3", "walk.mcap"])
def test_an_older_file_stays_until_the_new_one_is_whole(tmp_path, name, monkeypatch):
    path = tmp_path / name
    with BagWriter(path) as bag:
        bag.scan(scan())
    old = path.read_bytes()
    seen = []
    with pytest.raises(SourceError, match="-1 ns"):
        within(path, lambda bag: bag.odometry(S, (0, 0, 0)), lambda _: seen.append(path.read_bytes()), write_too_early)
    assert seen == [old]
    assert path.read_bytes() == old
    with monkeypatch.context() as patch:
        patch.setattr("rosbags.rosbag1.Writer.write", fill_up)
        patch.setattr("rosbags.rosbag2.Writer.write", fill_up)
        with pytest.raises(SourceError, match="No space left") as told:
            within(path, lambda bag: bag.odometry(S, (0, 0, 0)))
    assert "\n" not in str(told.value)
    assert path.read_bytes() == old
    within(path, lambda bag: bag.odometry(S, (0, 0, 0)))
    assert set(found(path)) == {"/odom", "/tf"}
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("name", NAMES)
def test_a_disk_that_fills_up_at_the_end(tmp_path, name, monkeypatch):
    monkeypatch.setattr(os, "fsync", fill_up)
    with pytest.raises(SourceError, match=r"walk.*No space left.*free space"):
        within(tmp_path / name, lambda bag: bag.scan(scan()))
    assert os.listdir(tmp_path) == []


def test_a_link_keeps_pointing(tmp_path):
    (tmp_path / "here").mkdir()
    (tmp_path / "latest.bag").symlink_to(tmp_path / "here/walk.bag")
    with BagWriter(tmp_path / "latest.bag") as bag:
        bag.scan(scan())
    assert (tmp_path / "latest.bag").is_symlink()
    assert "/scan" in found(tmp_path / "here/walk.bag")


def test_an_empty_folder_is_taken_and_a_full_one_refused(tmp_path):
    (tmp_path / "walk").mkdir()
    with BagWriter(tmp_path / "walk") as bag:
        bag.scan(scan())
    assert sorted(os.listdir(tmp_path / "walk")) == ["metadata.yaml", "walk.mcap"]
    before = (tmp_path / "walk/walk.mcap").read_bytes()
    with pytest.raises(SourceError, match="walk: exists and is not empty; give a new folder"):
        BagWriter(tmp_path / "walk")
    assert (tmp_path / "walk/walk.mcap").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere/walk.bag", "No such file or directory.*choose an existing folder"),
        ("nowhere/walk", "No such file or directory"),
        ("folder.bag", "is a folder; name a file"),
        ("a#b.db3", "misreads \\?, # and % in a name"),
    ],
)
def test_places_that_cannot_be(tmp_path, name, said):
    (tmp_path / "folder.bag").mkdir()
    with pytest.raises(SourceError, match=said) as told, BagWriter(tmp_path / name):
        pass
    assert "\n" not in str(told.value)
    assert os.listdir(tmp_path) == ["folder.bag"]


def mirror() -> np.ndarray:
    return np.diag([1.0, 1, -1, 1])


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda bag: bag.scan(scan(-1)), "-1 ns must be between 0 and 4294967296 seconds"),
        (lambda bag: bag.scan(scan(2**32 * 10**9)), "must be between 0 and 4294967296 seconds"),
        (lambda bag: bag.scan(scan(fault="unreadable", name="scan 3")), r"scan 3 has a fault \(unreadable\)"),
        (lambda bag: bag.depth(frame(np.empty((0, 0), np.uint16), fault="unreadable")), "image_raw: unreadable; only"),
        (lambda bag: bag.depth(frame(np.ones((3, 3), np.uint16))), r"\(3, 3\) pixels of a PinholeCamera"),
        (lambda bag: bag.odometry(S, (0, 0)), r"\(0, 0\) is not a pose"),
        (lambda bag: bag.pose(S, (0, np.nan, 0)), "is not a pose"),
        (lambda bag: bag.pose(S, (0, 0, 0), np.eye(2)), r"a covariance of \(2, 2\) on /amcl_pose"),
        (lambda bag: bag.transform(S, "map", "odom", mirror()), "map -> odom is not a rigid motion"),
        (lambda bag: bag.fixed("base", "laser", np.eye(3)), "base -> laser is not a rigid motion"),
        (lambda bag: bag.scan(scan(), "/odom"), "/odom holds nav_msgs/msg/Odometry, not sensor_msgs/msg/LaserScan"),
    ],
)
def test_what_cannot_be_written(tmp_path, write, said):
    with pytest.raises(SourceError, match=said) as told:
        within(tmp_path / "a.bag", lambda bag: bag.odometry(S, (0, 0, 0)), write)
    assert "\n" not in str(told.value)
    assert os.listdir(tmp_path) == []


def test_times_of_ros_2_end_sooner(tmp_path):
    last = 2**31 * 10**9 - 1
    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.scan(scan(last))
    assert time_of(only(tmp_path / "a.mcap", "/scan").header) == last
    with pytest.raises(SourceError, match="2147483648 seconds"), BagWriter(tmp_path / "a.mcap") as bag:
        bag.scan(scan(last + 1))


def test_a_writer_that_was_not_opened(tmp_path):
    with pytest.raises(SourceError, match="not open; write 'with"):
        BagWriter(tmp_path / "a.bag").scan(scan())


def test_without_rosbags_the_cure_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(MissingExtra, match=r"pip install 'stereovox\[bags\]'"):
        BagWriter(tmp_path / "a.bag")


@pytest.mark.parametrize("name", ["walk.bag", "walk.mcap"])
def test_memory_does_not_grow_with_the_recording(tmp_path, name):
    camera = PinholeCamera.from_field_of_view(640, 480, 57)
    noise = np.random.default_rng(0).integers(500, 5000, (480, 640)).astype(np.uint16)

    def peak(count: int) -> int:
        tracemalloc.start()
        with BagWriter(tmp_path / name) as bag:
            for k in range(count):
                bag.depth(Frame(noise, camera, np.eye(4), S + k * 10**8, 0.001))
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used

    peak(1)
    assert peak(40) < peak(4) + 2_000_000  # the 36 images more are 22 MB


@pytest.mark.parametrize("name", NAMES)
def test_a_bag_that_cannot_even_be_begun_leaves_nothing(tmp_path, monkeypatch, name):
    writer = rosbag1.Writer if name.endswith(".bag") else rosbag2.Writer
    monkeypatch.setattr(writer, "open", no_room)
    with pytest.raises(SourceError, match="No space left"), BagWriter(tmp_path / name):
        pass
    assert not list(tmp_path.iterdir())


def no_room(self):
    raise OSError(errno.ENOSPC, "No space left on device")
