# SPDX-License-Identifier: Apache-2.0
"""`.mcap` files of every make: any message of any topic, whatever is whole of a cut one, and no harm by a bad one."""

from __future__ import annotations

import random
import struct
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import made_mcap
import numpy as np
import pytest
from made_bags import stamp
from made_mcap import MAGIC, Message, Style, chunk_record, mcap, record, text
from rosbags.rosbag2 import Reader

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused, MissingExtra, SourceError
from stereovox.frame import Frame
from stereovox.opening import open_source
from stereovox.sources.bags import mcap as bag_mcap_index
from stereovox.sources.bags import mcap as bag_mcap_records
from stereovox.sources.bags import open_bag, suffix_of
from stereovox.sources.bags.mcap import McapFile, message_at
from stereovox.sources.bags.writer import BagWriter

TYPES = {"/a": "std_msgs/msg/String", "/b": "sensor_msgs/msg/Imu"}
ENOUGH = 30_000_000
STYLES = [
    Style(packing=packing, crc=crc, chunk=chunk)
    for packing in ("", "lz4", "zstd")
    for crc in (False, True)
    for chunk in (1, 4)
]
UNINDEXED = [
    Style(chunk=0),
    Style(index=False),
    Style(summary=False, packing="lz4"),
    Style(repeated=False, packing="zstd"),
    Style(twice=True, packing="zstd"),
    Style(summary=False, chunk=0),
]


def cdr(value: str) -> bytes:
    return b"\0\1\0\0" + struct.pack("<I", len(value) + 1) + value.encode() + b"\0"


def spoken(count: int = 10) -> list[Message]:
    """Messages of two topics, some out of order in time, and three of one time."""
    times = [stamp(k) for k in (0, 2, 1, 3, 5, 4, 6, 6, 6, 9)]
    dice = random.Random(3)
    said = [dice.randbytes(dice.randint(0, 60)).hex() for _ in range(count)]
    return [Message("/b" if k % 3 == 2 else "/a", times[k % 10] + k // 10 * 10**9, cdr(said[k])) for k in range(count)]


def expected(messages: list[Message], topic: str) -> list[Message]:
    return sorted((said for said in messages if said.topic == topic), key=lambda said: said.time)


def read_all(path: Path, order: int = 1) -> tuple[McapFile, dict[str, list[Message]]]:
    file = open_bag(path)
    assert isinstance(file, McapFile)
    found: dict[str, list[Message]] = {}
    for topic in file.types:
        stamps = file.stamps(topic)
        read = {i: bytes(file.read(topic, i)._view) for i in range(len(stamps))[::order]}
        found[topic] = [Message(topic, int(stamps[i]), read[i]) for i in range(len(stamps))]
    return file, found


@pytest.mark.parametrize("style", STYLES, ids=str)
def test_every_message_by_its_number(tmp_path, style):
    messages = spoken(23)
    file, found = read_all(mcap(tmp_path / "a.mcap", TYPES, messages, style), order=-1)
    assert file.types == {"/a": "std_msgs/String", "/b": "sensor_msgs/Imu"}
    assert found == {topic: expected(messages, topic) for topic in TYPES}
    assert file.notes == ()
    assert file.stamps("/a").dtype == np.int64


@pytest.mark.parametrize("style", [*STYLES, UNINDEXED[0], UNINDEXED[2]], ids=str)
def test_the_files_made_here_are_read_by_rosbags_as_well(tmp_path, style):
    messages = sorted(spoken(), key=lambda said: said.time)  # without an index rosbags wants them so
    with Reader(mcap(tmp_path / "a.mcap", TYPES, messages, style)) as reader:
        found = [Message(connection.topic, time, bytes(data)) for connection, time, data in reader.messages()]
    assert sorted(found, key=str) == sorted(messages, key=str)


@pytest.mark.parametrize("style", UNINDEXED, ids=str)
def test_without_a_useful_index_the_file_is_gone_through(tmp_path, style):
    messages = spoken(23)
    file, found = read_all(mcap(tmp_path / "a.mcap", TYPES, messages, style))
    assert found == {topic: expected(messages, topic) for topic in TYPES}
    (note,) = file.notes
    assert "scanned from the beginning" in note
    assert "lost" not in note


@pytest.mark.parametrize("packed", [True, False])
def test_what_rosbags_wrote(tmp_path, packed):
    camera = PinholeCamera.from_field_of_view(160, 120, 57)
    depth = np.random.default_rng(2).integers(500, 5000, (70, 120, 160)).astype(np.uint16)
    with BagWriter(tmp_path / "walk.mcap", packed=packed) as bag:
        for k in range(70):
            bag.odometry(stamp(k), (k, 0, 0))
            bag.depth(Frame(depth[k], camera, np.eye(4), stamp(k), 0.001))
    assert suffix_of(str(tmp_path / "walk.mcap")) == ".mcap"
    source = open_source(f"{tmp_path / 'walk.mcap'}?pose=fixed")
    assert len(source) == 70
    for k in (69, 0, 33, 34, 1):
        np.testing.assert_array_equal(source.frame(k).depth, depth[k])
        assert source.frame(k).stamp_ns == stamp(k)


def test_poses_in_an_mcap_file(tmp_path):
    camera = PinholeCamera(8, 6, 10.0, 10.5, 3.4, 2.6)
    with BagWriter(tmp_path / "walk.mcap") as bag:
        for k in (0, 2):
            bag.odometry(stamp(k), (k, 0, 0), topic="/odom", base_frame="camera_depth_optical_frame")
        bag.depth(Frame(np.full((6, 8), 900, np.uint16), camera, np.eye(4), stamp(1), 0.001))
    frame = open_source(f"{tmp_path / 'walk.mcap'}?poses=/odom").frame(0)
    np.testing.assert_allclose(frame.T_world_sensor[:3, 3], [1, 0, 0], atol=1e-6)


def test_ros_1_messages_in_an_mcap_file(tmp_path):
    said = Message("/a", 5, struct.pack("<I", 5) + b"hello")
    style = Style(encoding="ros1", profile="ros1")
    file = open_bag(mcap(tmp_path / "a.mcap", {"/a": "std_msgs/String"}, [said], style))
    assert file.types == {"/a": "std_msgs/String"}
    assert file.read("/a", 0).text() == "hello"


def test_other_encodings_are_none_of_ours(tmp_path):
    path = mcap(tmp_path / "a.mcap", {"/a": "Imu"}, [Message("/a", 5, b"{}")], Style(encoding="json"))
    assert open_bag(path).types == {}
    with pytest.raises(SourceError, match=r"no depth images .* it holds nothing at all"):
        open_source(path)


def test_messages_packed_by_themselves(tmp_path):
    from backports import zstd

    said = Message("/a", 5, zstd.compress(cdr("hello")))
    assert open_bag(mcap(tmp_path / "a.mcap", TYPES, [said])).read("/a", 0).text() == "hello"


def test_a_packing_that_nobody_knows(tmp_path):
    file = open_bag(mcap(tmp_path / "a.mcap", TYPES, spoken(), Style(packing="brotli")))
    with pytest.raises(FrameRefused, match="packed with 'brotli', which is unknown"):
        file.read("/a", 0)


def test_messages_of_one_time_keep_their_order(tmp_path):
    messages = [Message("/a", 5 - k % 2, cdr(str(k))) for k in range(200)]
    file = open_bag(mcap(tmp_path / "a.mcap", TYPES, messages))
    found = [file.read("/a", i).text() for i in range(200)]
    assert found == [str(k) for k in (*range(1, 200, 2), *range(0, 200, 2))]


def test_places_before_the_chunk_are_refused():
    data = made_mcap.message(1, 0, Message("/a", 5, cdr("hello"))) * 2
    assert message_at(data, len(data) // 2)[:2] == (1, 5)
    with pytest.raises(ValueError, match="points outside the chunk"):
        message_at(data, -len(data))


def test_content_counts_more_than_the_name(tmp_path):
    path = mcap(tmp_path / "a.mcap", TYPES, spoken()).rename(tmp_path / "recording.dat")
    assert suffix_of(str(path)) == ".mcap"
    assert set(open_bag(path).types) == set(TYPES)


@pytest.mark.parametrize(
    "style", [Style(packing=packing, crc=True) for packing in ("", "lz4", "zstd")] + UNINDEXED, ids=str
)
def test_cut_anywhere_whole_messages_stay(tmp_path, style):
    messages = spoken(40)
    data = mcap(tmp_path / "a.mcap", TYPES, messages, style).read_bytes()
    counts, said = [], set()
    for length in sorted({*range(0, len(data), 61), *range(len(data) - 40, len(data), 3)}):
        (tmp_path / "cut.mcap").write_bytes(data[:length])
        try:
            file, found = read_all(tmp_path / "cut.mcap")
        except SourceError as error:
            in_one_line(error, tmp_path / "cut.mcap")
            counts.append(0)
            said.add(str(error).partition(": ")[2].partition(";")[0])
            continue
        counts.append(sum(map(len, found.values())))
        kept = messages[: counts[-1]]  # in the order of the file
        assert found == {topic: part for topic in TYPES if (part := expected(kept, topic))}
        assert len(file.notes) == 1
    assert "cut off or damaged before the first message" in said
    assert counts == sorted(counts)  # once there are whole messages, they are taken
    assert counts[-1] == len(messages)
    assert len(set(counts)) > 8


def test_a_cut_recording_says_so_and_gives_its_frames(tmp_path):
    camera = PinholeCamera(64, 48, 50.0, 50.0, 31.5, 23.5)
    depth = np.random.default_rng(2).integers(500, 5000, (400, 48, 64)).astype(np.uint16)
    with BagWriter(tmp_path / "walk.mcap", packed=False) as bag:
        for k in range(400):
            bag.depth(Frame(depth[k], camera, np.eye(4), stamp(k), 0.001))
    data = (tmp_path / "walk.mcap").read_bytes()
    (tmp_path / "walk.mcap").write_bytes(data[: len(data) - 100_000])
    source = open_source(f"{tmp_path / 'walk.mcap'}?pose=fixed")
    assert 300 < len(source) < 400
    np.testing.assert_array_equal(source.frame(-1).depth, depth[len(source) - 1])
    assert "the file is cut off" in source.notes[0]
    assert "the rest is lost" in source.notes[0]


def in_one_line(error: Exception, path: Path, outcome: str = "closed") -> str:
    assert "\n" not in str(error)
    assert str(path) in str(error)
    return outcome


def used(path: Path) -> Iterator[str]:
    """Take every message of a file; whatever is wrong may only show as one line."""
    try:
        file = open_bag(path)
        for topic in file.types:
            for i in range(len(file.stamps(topic))):
                try:
                    file.read(topic, i)
                    yield "read"
                except FrameRefused as refused:
                    yield in_one_line(refused, path, refused.reason)
    except SourceError as error:
        yield in_one_line(error, path)


def outcomes(path: Path) -> set[str]:
    tracemalloc.start()
    found = set(used(path))
    assert found <= {"read", "unreadable", "closed"}
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < ENOUGH
    return found


@pytest.mark.parametrize("style", [*STYLES[::2], *UNINDEXED], ids=str)
def test_damaged_bytes(tmp_path, style):
    data = mcap(tmp_path / "a.mcap", TYPES, spoken(20), style).read_bytes()
    dice, found = random.Random(6), set()
    for _ in range(40):
        damaged = bytearray(data)
        for _ in range(dice.randint(1, 12)):
            damaged[dice.randrange(9, len(data))] = dice.choice((0, 1, 127, 255, dice.randrange(256)))
        (tmp_path / "damaged.mcap").write_bytes(damaged)
        found |= outcomes(tmp_path / "damaged.mcap")
    assert "read" in found


@pytest.mark.parametrize("packing", ["", "lz4", "zstd"])
def test_a_damaged_chunk_costs_its_own_messages_only(tmp_path, packing):
    messages, style = spoken(12), Style(packing=packing, crc=True, chunk=4)
    data = bytearray(mcap(tmp_path / "a.mcap", TYPES, messages, style).read_bytes())
    with Reader(tmp_path / "a.mcap") as reader:
        second = reader.storage.chunks[1].chunk_start_offset
    data[second + 80] ^= 0xFF
    (tmp_path / "a.mcap").write_bytes(data)
    file = open_bag(tmp_path / "a.mcap")
    of_second = set(messages[4:8])
    for topic in TYPES:
        for i, said in enumerate(expected(messages, topic)):
            if said in of_second:
                with pytest.raises(FrameRefused, match=rf"a\.mcap: message {i} of {topic}: "):
                    file.read(topic, i)
            else:
                assert bytes(file.read(topic, i)._view) == said.data
    (tmp_path / "a.mcap").write_bytes(data[:-8])  # now the index is of no use either
    file, found = read_all(tmp_path / "a.mcap")
    assert sum(map(len, found.values())) == 8
    assert "1 damaged chunks left out" in file.notes[0]


@pytest.mark.parametrize("style", [*STYLES[::4], *UNINDEXED[:3]], ids=str)
def test_sizes_that_lie(tmp_path, style):
    data = mcap(tmp_path / "a.mcap", TYPES, spoken(8), style).read_bytes()
    for size, huge in ((4, b"\xff\xff\xff\x7f"), (8, b"\xff" * 7 + b"\x7f"), (8, b"\xff" * 8), (8, bytes(8))):
        places = [i for i in range(9, len(data) - size) if int.from_bytes(data[i : i + size], "little") <= len(data)]
        for i in places[:: max(1, len(places) // 20)]:
            (tmp_path / "lying.mcap").write_bytes(data[:i] + huge + data[i + size :])
            outcomes(tmp_path / "lying.mcap")


@pytest.mark.parametrize("packing", ["lz4", "zstd"])
@pytest.mark.parametrize("told", [300_000_000, 1000, 2**63])
def test_a_chunk_that_swells(tmp_path, packing, told):
    path = mcap(tmp_path / "a.mcap", TYPES, spoken(4), Style(summary=False))
    swollen = bytearray(chunk_record(bytes(40_000_000), 1, 2, Style(packing=packing)))
    swollen[9 + 16 : 9 + 24] = struct.pack("<Q", told)
    data = path.read_bytes()
    end = data.index(record(15, bytes(4)))
    path.write_bytes(data[:end] + bytes(swollen) + data[end:])
    assert outcomes(path) == {"read"}
    assert "1 damaged chunks left out" in open_bag(path).notes[0]


def test_a_flood_of_records_is_refused(tmp_path, monkeypatch):
    path = mcap(tmp_path / "a.mcap", TYPES, spoken(40), Style(summary=False, packing="zstd"))
    monkeypatch.setattr(bag_mcap_index, "MAX_RECORDS", 30)
    with pytest.raises(SourceError, match="more than 30 records without an index; index it with 'mcap recover'"):
        open_bag(path)


def test_absurd_records_are_not_read(tmp_path, monkeypatch):
    path = mcap(tmp_path / "a.mcap", TYPES, spoken(40))
    monkeypatch.setattr(bag_mcap_records, "MAX_BYTES", 250)
    assert outcomes(path) <= {"read", "unreadable", "closed"}
    assert outcomes(path) != {"read"}


@pytest.mark.parametrize(
    "content",
    [
        MAGIC,
        MAGIC[:5],
        MAGIC * 8,
        MAGIC + record(1, text("ros2") + text("")),
        MAGIC + record(1, text("ros2") + text("")) + bytes(100),
        MAGIC + record(1, b"") + MAGIC,
        b"\x89PNG\r\n\x1a\n" + bytes(100),
    ],
)
def test_files_that_are_something_else(tmp_path, content):
    (tmp_path / "a.mcap").write_bytes(content)
    assert outcomes(tmp_path / "a.mcap") == {"closed"}


def test_an_empty_recording_holds_nothing(tmp_path):
    path = mcap(tmp_path / "a.mcap", TYPES, [])
    assert open_bag(path).types == {}
    (tmp_path / "b.mcap").write_bytes(b"")
    with pytest.raises(SourceError, match="the file is empty"):
        open_bag(tmp_path / "b.mcap")


@pytest.mark.parametrize(("packing", "module"), [("lz4", "lz4.frame"), ("zstd", "backports")])
def test_without_what_unpacks_it_the_cure_is_one_line(tmp_path, monkeypatch, packing, module):
    whole = mcap(tmp_path / "a.mcap", TYPES, spoken(), Style(packing=packing))
    monkeypatch.setitem(sys.modules, module, None)
    cure = rf"{packing} is not installed; run: pip install 'stereovox\[bags\]'"
    with pytest.raises(FrameRefused, match=cure):
        open_bag(whole).read("/a", 0)
    with pytest.raises(MissingExtra, match=cure):
        open_bag(mcap(tmp_path / "b.mcap", TYPES, spoken(), Style(packing=packing, summary=False)))


def test_rosbags_is_not_needed_for_what_is_not_packed(tmp_path, monkeypatch):
    path = mcap(tmp_path / "a.mcap", TYPES, spoken())
    for module in ("rosbags", "lz4.frame", "backports"):
        monkeypatch.setitem(sys.modules, module, None)
    assert read_all(path)[1] == {topic: expected(spoken(), topic) for topic in TYPES}
