# SPDX-License-Identifier: Apache-2.0
"""Folders of rosbag2: one recording, however many files it was split into and however they are packed."""

from __future__ import annotations

import shutil
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
from made_mcap import Message, Style, mcap
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import SourceError
from stereovox.frame import Frame
from stereovox.opening import open_source
from stereovox.sources.bags import FOLDER, open_bag, suffix_of
from stereovox.sources.bags.files import FolderFile
from stereovox.sources.bags.writer import BagWriter

CAMERA = PinholeCamera(8, 6, 10.0, 10.5, 3.4, 2.6)
TYPES = {"/a": "std_msgs/msg/String", "/b": "std_msgs/msg/String"}
S = 1_700_000_000_000_000_000
MODES = [
    (StoragePlugin.SQLITE3, CompressionMode.NONE),
    (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    (StoragePlugin.MCAP, CompressionMode.NONE),
    (StoragePlugin.MCAP, CompressionMode.MESSAGE),
    (StoragePlugin.MCAP, CompressionMode.STORAGE),
]


def depth(k: int) -> np.ndarray:
    return (1000 + 100 * k + np.arange(48).reshape(6, 8)).astype(np.uint16)


def frame(k: int) -> Frame:
    return Frame(depth(k), CAMERA, np.eye(4), S + k * 10**8, 0.001)


def recorded(path: Path, count: int = 3) -> Path:
    with BagWriter(path) as bag:
        for k in range(count):
            bag.depth(frame(k))
    return path


def by_rosbags(path: Path, plugin: StoragePlugin, mode: CompressionMode, count: int = 5) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "std_msgs/msg/String"
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = [writer.add_connection(topic, kind, typestore=store) for topic in TYPES]
        for k in range(count):
            text = store.types[kind](data=f"message {k}")
            writer.write(connections[k % 2], S + k, store.serialize_cdr(text, kind))
    return path


def split(path: Path, *parts: list[tuple[str, int]], named: bool = True) -> Path:
    """A folder of several files, of messages with topic and time, each of which says its topic and time."""
    path.mkdir()
    names = [f"{path.name}_{k}.mcap" for k in range(len(parts))]
    for name, part in zip(names, parts, strict=True):
        said = [
            Message(topic, time, b"\0\1\0\0" + bytes([5, 0, 0, 0]) + f"{topic}{time:02}\0".encode())
            for topic, time in part
        ]
        mcap(path / name, TYPES, said, Style(packing="zstd"))
    if named:
        describe(path, [f"{path.name}/{name}" for name in names])  # rosbag2 before version 4 told the folder as well
    return path


def describe(path: Path, names: object, **other: object) -> None:
    told = {"version": 5, "storage_identifier": "mcap", "relative_file_paths": names, **other}
    (path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": told}))


def said(folder: Path, topic: str) -> list[str]:
    file = open_bag(folder)
    return [file.read(topic, i).text() for i in range(len(file.stamps(topic)))]


def complaint(folder: Path) -> str:
    with pytest.raises(SourceError) as caught:
        open_bag(folder)
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)
    return str(caught.value)


def test_a_folder_gives_depth_frames(tmp_path):
    recorded(tmp_path / "walk")
    for where in (f"{tmp_path}/walk", f"{tmp_path}/walk/", f"{tmp_path}/walk?depth=/camera/depth/image_raw"):
        source = open_source(where)
        assert (source.name, len(source), source.camera, source.notes) == ("walk", 3, CAMERA, ())
        for k in (2, 0, 1):
            np.testing.assert_array_equal(source.frame(k).depth, depth(k))
            assert source.frame(k).stamp_ns == S + k * 10**8


def test_a_question_mark_in_a_folder_name_is_part_of_it(tmp_path):
    assert len(open_source(recorded(tmp_path / "what?"))) == 3


@pytest.mark.parametrize(("plugin", "mode"), MODES)
def test_what_rosbags_writes(tmp_path, plugin, mode):
    folder = by_rosbags(tmp_path / "walk", plugin, mode)
    assert suffix_of(str(folder)) == FOLDER
    file = open_bag(folder)
    assert isinstance(file, FolderFile)
    assert file.types == {"/a": "std_msgs/String", "/b": "std_msgs/String"}
    assert file.stamps("/a").tolist() == [S, S + 2, S + 4]
    assert said(folder, "/a") == ["message 0", "message 2", "message 4"]
    assert said(folder, "/b") == ["message 1", "message 3"]


@pytest.mark.parametrize("plugin", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_files_packed_as_a_whole_say_how_to_unpack_them(tmp_path, plugin):
    folder = by_rosbags(tmp_path / "walk", plugin, CompressionMode.FILE)
    (packed,) = folder.glob("*.zstd")
    assert f"packed as a whole; unpack it with: zstd -d '{packed}' -o '{packed.with_suffix('')}'" in complaint(folder)
    from backports import zstd

    packed.with_suffix("").write_bytes(zstd.decompress(packed.read_bytes()))  # what that command does
    assert said(folder, "/a") == ["message 0", "message 2", "message 4"]


def test_split_recordings_are_one(tmp_path):
    folder = split(tmp_path / "walk", [("/a", 1), ("/a", 3)], [("/a", 2), ("/b", 7)], [("/a", 9)])
    file = open_bag(folder)
    assert file.stamps("/a").tolist() == [1, 2, 3, 9]
    assert said(folder, "/a") == ["/a01", "/a02", "/a03", "/a09"]
    assert said(folder, "/b") == ["/b07"]
    assert file.notes == ()


def test_a_split_that_begins_without_a_topic(tmp_path):
    folder = split(tmp_path / "walk", [("/b", 1)], [("/a", 2)])
    assert (said(folder, "/a"), said(folder, "/b")) == (["/a02"], ["/b01"])


def test_the_order_of_files_is_that_of_the_metadata_for_equal_times(tmp_path):
    folder = split(tmp_path / "walk", [("/a", 5), ("/b", 1)], [("/a", 5), ("/b", 2)])
    names = ["walk_1.mcap", "walk_0.mcap", "walk_1.mcap"]  # told twice, read once
    describe(folder, names)
    assert open_bag(folder).stamps("/a").tolist() == [5, 5]
    assert said(folder, "/b") == ["/b01", "/b02"]


def test_without_metadata_the_numbered_files_are_taken(tmp_path):
    parts = [[("/a", k)] for k in range(11)]
    folder = split(tmp_path / "walk", *parts, named=False)
    (folder / "notes.txt").write_text("by hand")
    last = folder / "walk_10.mcap"
    last.write_bytes(last.read_bytes()[:-30])
    assert suffix_of(str(folder)) == FOLDER
    assert said(folder, "/a") == [f"/a{k:02}" for k in range(11)]
    notes = open_bag(folder).notes
    assert (
        "no metadata.yaml, as after an interrupted recording: using walk_0.mcap, walk_1.mcap, walk_2.mcap and 8"
        in notes[0]
    )
    assert "walk_10.mcap: the file is cut off" in notes[1]


def test_folders_that_are_something_else(tmp_path):
    assert suffix_of(str(tmp_path)) == ""
    (tmp_path / "metadata.yaml").write_text("title: holidays\n")
    assert suffix_of(str(tmp_path)) == ""
    with pytest.raises(SourceError, match="no recording"):
        open_source(tmp_path)
    (tmp_path / "metadata.yaml").unlink()
    for name in ("walk_0.mcap", "other_1.mcap"):
        (tmp_path / name).write_bytes(b"")
    assert suffix_of(str(tmp_path)) == ""
    assert "no metadata.yaml in it; give the folder that rosbag2 made" in complaint(tmp_path)


def test_a_missing_file_is_named(tmp_path):
    folder = split(tmp_path / "walk", [("/a", 1)], [("/a", 2)])
    (folder / "walk_1.mcap").unlink()
    assert "walk_1.mcap: is missing; copy the whole folder" in complaint(folder)


def test_files_outside_of_the_folder_are_not_opened(tmp_path):
    folder = split(tmp_path / "walk", [("/a", 1)])
    shutil.copy(folder / "walk_0.mcap", tmp_path / "secret.mcap")
    describe(folder, ["../secret.mcap"])
    assert "walk/secret.mcap: is missing" in complaint(folder)
    describe(folder, [".."])
    assert "is missing" in complaint(folder)


@pytest.mark.parametrize("names", [None, [], {}, 7, [7], [None], [[]], "walk_0.mcap", [""]])
def test_metadata_that_names_no_files(tmp_path, names):
    folder = split(tmp_path / "walk", [("/a", 1)])
    describe(folder, names)
    assert "metadata.yaml: names no files; write it again with 'ros2 bag reindex'" in complaint(folder)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\0\1\2",
        b"\xff\xfe\xfd",
        b"- rosbag2_bagfile_information",
        b"rosbag2_bagfile_information: 7",
        b"rosbag2_bagfile_information:\n  a: [1",
        b"rosbag2_bagfile_information:\n  a: !!python/object/apply:os.system ['true']",
        b"[" * 20_000,
        b"rosbag2_bagfile_information: {a: " + b"[" * 20_000,
    ],
)
def test_damaged_metadata(tmp_path, content):
    folder = split(tmp_path / "walk", [("/a", 1)])
    (folder / "metadata.yaml").write_bytes(content)
    assert "metadata.yaml: " in complaint(folder)


def test_huge_metadata_are_not_read(tmp_path):
    folder = split(tmp_path / "walk", [("/a", 1)])
    with (folder / "metadata.yaml").open("ab") as file:
        file.truncate(2_000_000_000)
    tracemalloc.start()
    assert "holds more than 1048576 bytes" in complaint(folder)
    assert tracemalloc.get_traced_memory()[1] < 30_000_000
    tracemalloc.stop()


def test_one_damaged_file_ends_in_one_line(tmp_path):
    folder = split(tmp_path / "walk", [("/a", 1)], [("/a", 2)])
    (folder / "walk_1.mcap").write_bytes(b"no recording at all")
    assert "walk_1.mcap: neither a ROS 1 bag" in complaint(folder)


def test_poses_of_a_pair_may_stand_in_a_folder(tmp_path):
    with BagWriter(tmp_path / "tracker") as bag:
        for k in range(3):
            bag.pose(S + k * 10**8 - 3 * 10**7, (0.01 * k, 0, 0), topic="/pose")
            bag.pose(S + k * 10**8 + 3 * 10**7, (0.01 * k, 0, 0), topic="/pose")
    recorded(tmp_path / "walk.mcap")
    identity = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
    pair = f"depth = 'walk.mcap'\nposes = 'tracker'\naxes = 'optical'\nworld = 'file'\nT_tracker_camera = {identity}\n"
    (tmp_path / "pair.toml").write_text(pair)
    np.testing.assert_allclose([f.T_world_sensor[0, 3] for f in open_source(tmp_path)], [0, 0.01, 0.02], atol=1e-9)
