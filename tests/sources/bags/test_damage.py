# SPDX-License-Identifier: Apache-2.0
"""Files that are cut off, damaged, lying or something else: one line each, and no memory for what is not there."""

from __future__ import annotations

import os
import random
import sqlite3
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from made_bags import START_NS, STREAM, Bag, camera_info, depth, image, realsense_bag, ros_bag, stamp, store, text

from stereovox.errors import SourceError
from stereovox.frame import Frame
from stereovox.opening import open_source
from stereovox.sources.bags import ros1
from stereovox.sources.bags.messages import Wire, read_camera_info, read_image
from stereovox.sources.bags.recording import Bag as BagSource

TOPIC, INFO = "/depth/image", "/depth/camera_info"
FAULTS = {None, "unreadable", "bad_dtype", "bad_shape", "no_camera", "no_pose", "bad_pose_file"}
ENOUGH = 30_000_000


def taken(path: Path) -> tuple[list[Frame], str]:
    try:
        return list(open_source(path)), ""
    except SourceError as error:
        return [], str(error)


def outcomes(path: Path) -> set[str | None]:
    """Open a file and take every frame; whatever is wrong may only show as SourceError in one line, or as a fault."""
    tracemalloc.start()
    frames, said = taken(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < ENOUGH
    if said:
        assert "\n" not in said
        assert str(path) in said
        return {"closed"}
    for frame in frames:
        assert "\n" not in frame.fault_detail
        assert (frame.fault is None) == (frame.fault_detail == "")
    assert {frame.fault for frame in frames} <= FAULTS
    return {frame.fault for frame in frames}


@pytest.mark.parametrize("name", ["empty.bag", "empty.db3"])
def test_empty_files(tmp_path, name):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(SourceError, match="the file is empty"):
        open_source(tmp_path / name)


@pytest.mark.parametrize("content", [b"x", b"#ROSBAG V1.2\n" + b"\0" * 100, b"SQLite format 2" * 100, b"\0" * 5000])
@pytest.mark.parametrize("name", ["other.bag", "other.db3"])
def test_files_that_are_something_else(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert outcomes(tmp_path / name) == {"closed"}


def test_content_counts_more_than_the_name(tmp_path):
    renamed = ros_bag(tmp_path / "a.bag", 2).rename(tmp_path / "recording.dat")
    assert len(open_source(renamed)) == 2


def test_a_database_of_something_else(tmp_path):
    sqlite3.connect(tmp_path / "a.db3").execute("CREATE TABLE people (name TEXT)").connection.commit()
    with pytest.raises(SourceError, match=r"a\.db3: no such table: topics; not a \.db3 recording"):
        open_source(tmp_path / "a.db3")


def test_a_bag_of_a_recording_that_broke_off(tmp_path):
    path = ros_bag(tmp_path / "a.bag", 2)
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)  # what rosbag writes at first, and corrects in the end
    path.write_bytes(data)
    with pytest.raises(SourceError, match=r"not indexed.*rosbag reindex"):
        open_source(path)


@pytest.mark.parametrize("packed", ["", "lz4", "bz2"])
def test_every_way_to_cut_a_bag(tmp_path, packed):
    data = realsense_bag(tmp_path / "a.bag", 2, packed).read_bytes()
    for length in range(0, len(data), max(1, len(data) // 25)):
        (tmp_path / "cut.bag").write_bytes(data[:length])
        assert outcomes(tmp_path / "cut.bag") == {"closed"}


@pytest.mark.parametrize("packed", ["", "lz4", "bz2"])
def test_damaged_bytes_in_a_bag(tmp_path, packed):
    data = realsense_bag(tmp_path / "a.bag", 3, packed).read_bytes()
    dice, found = random.Random(5), set()
    for _ in range(70):
        damaged = bytearray(data)
        for _ in range(dice.randint(1, 12)):
            damaged[dice.randrange(len(data))] = dice.choice((0, 1, 127, 255, dice.randrange(256)))
        (tmp_path / "damaged.bag").write_bytes(damaged)
        found |= outcomes(tmp_path / "damaged.bag")
    assert "closed" in found
    assert found & {"unreadable", "no_pose"}


def test_sizes_that_lie_in_a_bag(tmp_path):
    data = ros_bag(tmp_path / "a.bag", 2).read_bytes()
    places = [i for i in range(0, len(data) - 4) if 8 <= struct.unpack_from("<I", data, i)[0] <= len(data)]
    for i in places[:: max(1, len(places) // 100)]:
        lying = bytearray(data)
        lying[i : i + 4] = b"\xff\xff\xff\xff"
        (tmp_path / "lying.bag").write_bytes(lying)
        outcomes(tmp_path / "lying.bag")


def test_a_chunk_that_swells_is_refused(tmp_path, monkeypatch):
    with Bag(tmp_path / "a.bag", "bz2") as bag:
        bag.add("/chatter", "std_msgs/String", START_NS, text("a" * 50_000))
        bag.add(TOPIC, "sensor_msgs/Image", stamp(0), image(depth(0), "16UC1", stamp(0)))
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), camera_info())
    assert bag.path.stat().st_size < 20_000
    assert outcomes(bag.path) == {"no_pose"}
    monkeypatch.setattr(ros1, "MAX_BYTES", 20_000)
    with pytest.raises(SourceError, match=r"/depth/camera_info: .* a chunk unpacks to an absurd size"):
        open_source(f"{bag.path}?depth={TOPIC}")


def one_image(path: Path, message, extra: bytes = b"") -> Path:
    with Bag(path) as bag:
        bag.add(TOPIC, "sensor_msgs/Image", stamp(0), image(depth(0), "16UC1", stamp(0)))
        bag.add(TOPIC, "sensor_msgs/Image", stamp(1), message, extra)
        bag.add(TOPIC, "sensor_msgs/Image", stamp(2), image(depth(2), "16UC1", stamp(2)))
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), camera_info())
    return path


@pytest.mark.parametrize(
    ("changed", "fault"),
    [
        ({"height": 600_000, "width": 700_000}, "bad_shape"),
        ({"height": 5}, "bad_shape"),
        ({"step": 3}, "unreadable"),
        ({"step": 4_000_000_000}, "unreadable"),
        ({"data": np.zeros(20, np.uint8)}, "unreadable"),
        ({"encoding": "bgr8"}, "bad_dtype"),
        ({"encoding": ""}, "bad_dtype"),
    ],
)
def test_one_bad_image_is_one_fault(tmp_path, changed, fault):
    message = image(depth(1), "16UC1", stamp(1))
    for name, value in changed.items():
        setattr(message, name, value)
    source = BagSource(f"{one_image(tmp_path / 'a.bag', message)}?pose=fixed")
    assert [frame.fault for frame in source] == [None, fault, None]
    assert "frame 1" in source.frame(1).fault_detail
    np.testing.assert_array_equal(source.frame(2).depth, depth(2))


@pytest.mark.parametrize("size", [(0, 0), (4_000_000_000, 3), (100_000, 100_000)])
def test_an_impossible_camera(tmp_path, size):
    with Bag(tmp_path / "a.bag") as bag:
        bag.add(TOPIC, "sensor_msgs/Image", stamp(0), image(depth(0), "16UC1", stamp(0)))
        told = camera_info(*size)
        told.K[0] = told.K[4] = 1e9
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), told)
    with pytest.raises(SourceError, match=INFO) as caught:
        open_source(bag.path)
    assert "\n" not in str(caught.value)


def test_every_cut_of_a_message_is_a_plain_error(tmp_path):
    for kind, message, read in (
        ("sensor_msgs/msg/Image", image(depth(0), "16UC1", stamp(0), "optical"), read_image),
        ("sensor_msgs/msg/CameraInfo", camera_info(), read_camera_info),
    ):
        whole = bytes(store().serialize_ros1(message, kind))
        read(Wire(whole, cdr=False))
        tail = 25 if "Info" in kind else 0  # binning and region of interest are not read
        for length in range(len(whole) - tail):
            with pytest.raises(ValueError, match="bytes are announced"):
                read(Wire(whole[:length], cdr=False))


def test_the_depth_unit_is_read_only_where_librealsense_puts_it():
    for frame_id, extra, unit in (("1", struct.pack("<f", 0.25), 0.25), ("1", b"", None), ("cam", b"\0\0\0\1", None)):
        taken = image(depth(0), "mono16", stamp(0), frame_id)
        data = bytes(store().serialize_ros1(taken, "sensor_msgs/msg/Image")) + extra
        assert read_image(Wire(data, cdr=False)).depth_units == unit


def cdr(kind: str, message) -> bytes:
    from rosbags.typesys import Stores, get_typestore

    return bytes(get_typestore(Stores.ROS2_HUMBLE).serialize_cdr(message, kind))


def ros2_image(k: int):
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE).types
    time = types["builtin_interfaces/msg/Time"](sec=stamp(k) // 10**9, nanosec=stamp(k) % 10**9)
    pixels = depth(k)
    return types["sensor_msgs/msg/Image"](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id="optical"),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding="mono16",
        is_bigendian=0,
        step=2 * pixels.shape[1],
        data=np.frombuffer(pixels.tobytes(), np.uint8),
    )


def ros2_string(value: str) -> bytes:
    text = value.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(text)) + text


def db3(path: Path, count: int = 3, pack=lambda data: data) -> Path:
    """A .db3 as librealsense 2.57 wrote it: whole images, each message packed by itself if at all."""
    file = sqlite3.connect(path)
    file.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT)")
    file.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    camera = "width=8;height=6;fx=10;ppx=3.5;fy=10.5;ppy=2.5;model=Brown Conrady;coeffs=0,0,0,0,0"
    names = {
        1: (f"{STREAM}/camera_info", "std_msgs/msg/String"),
        2: (f"{STREAM}/image/data", "sensor_msgs/msg/Image"),
        3: (f"{STREAM}/image/metadata", "std_msgs/msg/String"),
        4: ("/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/String"),
    }
    file.executemany("INSERT INTO topics VALUES (?, ?, ?)", [(key, *rest) for key, rest in names.items()])
    rows = [(1, 0, ros2_string(camera)), (4, 0, ros2_string("0.000250"))]
    for k in range(count):
        rows.append((2, 1000 + k, cdr("sensor_msgs/msg/Image", ros2_image(k))))
        milliseconds = f"{stamp(k) // 10**6}.{stamp(k) % 10**6:06d}"
        rows.append((3, 1000 + k, ros2_string(f"Frame number={k};timestamp={milliseconds};")))
    packed = [(topic, time, pack(data)) for topic, time, data in rows]
    file.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", packed)
    file.commit()
    file.close()
    return path


@pytest.mark.parametrize("packed", [False, True])
def test_db3_of_2_57(tmp_path, packed):
    zstandard = pytest.importorskip("zstandard")
    pack = zstandard.ZstdCompressor(1).compress if packed else bytes
    source = BagSource(f"{db3(tmp_path / 'a.db3', pack=pack)}?pose=fixed")
    assert source.camera.fx == 10
    for k, frame in enumerate(source):
        np.testing.assert_array_equal(frame.depth, depth(k))
        assert frame.stamp_ns == stamp(k)
        assert frame.depth_scale == 0.00025
        assert frame.fault is None


def test_packed_messages_that_lie(tmp_path):
    zstandard = pytest.importorskip("zstandard")
    path = db3(tmp_path / "a.db3")
    swollen = zstandard.ZstdCompressor(1).compress(bytes(300_000_000))
    file = sqlite3.connect(path)
    for row, data in zip((5, 7), (swollen, swollen[: len(swollen) // 2]), strict=True):
        file.execute("UPDATE messages SET data = ? WHERE id = ?", (data, row))
    file.commit()
    file.close()
    tracemalloc.start()
    faults = [frame.fault for frame in BagSource(f"{path}?pose=fixed")]
    assert tracemalloc.get_traced_memory()[1] < ENOUGH
    tracemalloc.stop()
    assert faults == [None, "unreadable", "unreadable"]


def test_cut_and_damaged_db3(tmp_path):
    data = db3(tmp_path / "a.db3", 4).read_bytes()
    dice, found = random.Random(7), set()
    for length in range(0, len(data), 1500):
        (tmp_path / "cut.db3").write_bytes(data[:length])
        found |= outcomes(tmp_path / "cut.db3")
    assert "closed" in found
    for _ in range(80):
        damaged = bytearray(data)
        for _ in range(dice.randint(1, 30)):
            damaged[dice.randrange(len(data))] = dice.choice((0, 1, 127, 255, dice.randrange(256)))
        (tmp_path / "damaged.db3").write_bytes(damaged)
        found |= outcomes(tmp_path / "damaged.db3")
    assert {"closed", "no_pose"} <= found


@pytest.mark.parametrize("value", [None, "text", 7])
def test_a_message_that_is_no_bytes(tmp_path, value):
    path = db3(tmp_path / "a.db3")
    file = sqlite3.connect(path)
    file.execute("UPDATE messages SET data = ? WHERE id = 3", (value,))
    file.commit()
    file.close()
    assert [frame.fault for frame in BagSource(f"{path}?pose=fixed")] == ["unreadable", None, None]


def test_a_time_that_is_none_is_told_in_one_line(tmp_path):
    path = db3(tmp_path / "a.db3")
    file = sqlite3.connect(path)
    file.execute("UPDATE messages SET timestamp = 'noon' WHERE topic_id = 2")
    file.commit()
    file.close()
    assert outcomes(path) == {"closed"}


def test_a_topic_without_a_number_is_none(tmp_path):
    path = db3(tmp_path / "a.db3")
    file = sqlite3.connect(path)
    file.execute("CREATE TABLE loose(id, name, type)")
    file.execute("INSERT INTO loose SELECT nullif(id, 2), name, type FROM topics")
    file.execute("DROP TABLE topics")
    file.execute("ALTER TABLE loose RENAME TO topics")
    file.execute("CREATE TABLE others(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
    file.execute("INSERT INTO others SELECT id, nullif(topic_id, 2), timestamp, data FROM messages")
    file.execute("DROP TABLE messages")
    file.execute("ALTER TABLE others RENAME TO messages")
    file.commit()
    file.close()
    assert outcomes(path) == {"closed"}


def test_a_named_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "walk.db3")
    with pytest.raises(SourceError, match="is neither a file nor a folder"):
        open_source(tmp_path / "walk.db3")


def test_a_damaged_last_image_does_not_hide_the_clocks_of_a_pair(tmp_path):
    path = db3(tmp_path / "walk.db3")
    file = sqlite3.connect(path)
    file.execute("UPDATE messages SET data = 'text' WHERE topic_id = 2 AND timestamp = 1002")
    file.commit()
    file.close()
    poses = (f"{stamp(0) // 10**9 + 0.01 * k:.2f} 0 0 0 0 0 0 1\n" for k in range(-5, 20))
    (tmp_path / "tracker.txt").write_text("".join(poses))
    identity = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    (tmp_path / "pair.toml").write_text(f"depth = 'walk.db3'\nT_tracker_camera = {identity}\n")
    assert [frame.fault for frame in open_source(tmp_path)] == [None, None, "unreadable"]


def test_huge_header_times_do_not_overflow(tmp_path):
    last = bytearray(store().serialize_ros1(image(depth(1), "16UC1", stamp(1)), "sensor_msgs/msg/Image"))
    last[4:12] = struct.pack("<II", 4_294_967_295, 999_999_999)
    frame = BagSource(f"{one_image(tmp_path / 'a.bag', bytes(last))}?pose=fixed").frame(1)
    assert frame.stamp_ns == 4_294_967_295_999_999_999
    assert np.int64(frame.stamp_ns) == frame.stamp_ns
    assert frame.stamp_ns > START_NS
