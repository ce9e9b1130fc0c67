# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sqlite3
import struct
import zlib

import cv2
import made_rooms as room
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.rtabmap_db import RtabmapDatabase

TO_NODE = inverse(room.T_BASE_CAMERA)


def png(image):
    return cv2.imencode(".png", image)[1].tobytes()


def png_of_floats(image):
    return png((image / 1000).astype("<f4").view(np.uint8).reshape(48, 64, 4))


def png_of_two(image):
    return png(np.hstack([image, image // 2]))


def rvl(image):
    """Pack an image as RVL: runs of zeros and of steps, in groups of three bits."""
    groups = []

    def add(number):
        while True:
            number, group = number >> 3, number & 7
            groups.append(group | (8 if number else 0))
            if not number:
                return

    flat, at, last = image.ravel().astype(int).tolist(), 0, 0
    while at < len(flat):
        zeros = next((k for k, value in enumerate(flat[at:]) if value), len(flat) - at)
        at += zeros
        others = next((k for k, value in enumerate(flat[at:]) if not value), len(flat) - at)
        add(zeros)
        add(others)
        for value in flat[at : at + others]:
            step = value - last
            add(2 * step if step >= 0 else -2 * step - 1)
            last = value
        at += others
    groups += [0] * (-len(groups) % 8)
    words = [sum(group << (28 - 4 * k) for k, group in enumerate(groups[n : n + 8])) for n in range(0, len(groups), 8)]
    return b"DEPTHRVL" + struct.pack(f"<2I{len(words)}I", image.shape[1], image.shape[0], *words)


def packed(K=True, P=True, kind=0):
    k = np.array([room.FX, 0, room.CX, 0, room.FY, room.CY, 0, 0, 1])
    p = np.array([room.FX, 0, room.CX, 0, 0, room.FY, room.CY, 0, 0, 0, 1, 0])
    head = struct.pack("<11i", 0, 21, 0, kind, 64, 48, 9 * K, 0, 0, 12 * P, 12)
    return (
        head
        + (k.tobytes() if K else b"")
        + (p.tobytes() if P else b"")
        + room.T_BASE_CAMERA[:3].astype("<f4").tobytes()
    )


def floats():
    numbers = [room.FX, room.FY, room.CX, room.CY, 64, 48, *room.T_BASE_CAMERA[:3].ravel()]
    return np.array(numbers, "<f4").tobytes()


def blob(T):
    return T[:3].astype("<f4").tobytes()


def matrix(array):
    """Pack a matrix as RTAB-Map does: zlib, then rows, columns and type."""
    return zlib.compress(array.tobytes()) + struct.pack("<3i", 1, array.size, 0)


def database(path, version="0.21.0", calibration=None, pack=png, drift=0.0, optimised=True, sessions=None):
    file = sqlite3.connect(path)
    file.execute("CREATE TABLE Node (id INTEGER, map_id INTEGER, stamp FLOAT, pose BLOB)")
    file.execute("CREATE TABLE Data (id INTEGER, image BLOB, depth BLOB, calibration BLOB)")
    file.execute("CREATE TABLE Link (from_id INTEGER, to_id INTEGER, type INTEGER)")
    file.execute("CREATE TABLE Admin (version TEXT, opt_ids BLOB, opt_poses BLOB)")
    ids, poses = [], []
    for k in range(room.COUNT):
        T = room.pose(k) @ TO_NODE
        ids.append(k + 1)
        poses.append(T[:3].astype("<f4"))
        T[0, 3] += drift * k
        node = k + 1, sessions[k] if sessions else 0, 100 + 0.5 * k, blob(T)
        file.execute("INSERT INTO Node VALUES (?, ?, ?, ?)", node)
        data = k + 1, pack(room.depth_mm(k)), calibration or packed()
        file.execute("INSERT INTO Data VALUES (?, NULL, ?, ?)", data)
    graph = (matrix(np.array(ids, "<i4")), matrix(np.array(poses, "<f4"))) if optimised else (None, None)
    file.execute("INSERT INTO Admin VALUES (?, ?, ?)", (version, *graph))
    file.execute("INSERT INTO Link VALUES (5, 1, 1)")
    file.commit()
    file.close()
    return path


@pytest.mark.parametrize(
    "pack", [png, rvl, lambda mm: png((mm / 1000).astype("<f4").view(np.uint8).reshape(48, 64, 4))]
)
def test_frames_are_those_of_the_room(tmp_path, pack):
    source = open_source(database(tmp_path / "walk.db", pack=pack))
    assert isinstance(source, RtabmapDatabase)
    assert (source.name, source.notes) == ("walk", ())
    for k, frame in enumerate(source):
        room.check(frame, k)
        assert frame.stamp_ns == 100 * 10**9 + k * 500_000_000


@pytest.mark.parametrize(
    ("version", "calibration"), [("0.18.0", packed(P=False)), ("0.18.0", packed(K=False)), ("0.17.6", floats())]
)
def test_calibrations_of_all_versions(tmp_path, version, calibration):
    source = open_source(database(tmp_path / "walk.db", version, calibration))
    np.testing.assert_allclose((source.camera.fx, source.camera.cy), (room.FX, room.CY))
    np.testing.assert_allclose(source.frame(2).T_world_sensor, room.pose(2), atol=1e-5)


def test_the_poses_of_the_optimised_graph_come_before_those_of_odometry(tmp_path):
    room.check(open_source(database(tmp_path / "a.db", drift=0.3)).frame(4), 4)
    source = open_source(database(tmp_path / "b.db", drift=0.3, optimised=False))
    assert "1 loop closures are not used" in source.notes[0]
    np.testing.assert_allclose(source.frame(4).T_world_sensor[0, 3], room.pose(4)[0, 3] + 1.2, atol=1e-4)


def test_without_a_graph_only_the_longest_session_counts(tmp_path):
    source = open_source(database(tmp_path / "walk.db", optimised=False, sessions=[0, 1, 1, 1, 0]))
    assert len(source) == 3
    assert "2 images of 1 other sessions left out" in source.notes[0]
    room.check(source.frame(0), 1)


def test_images_of_several_cameras_become_frames(tmp_path):
    both = packed() * 2
    source = open_source(
        database(tmp_path / "walk.db", calibration=both, pack=lambda mm: png(np.hstack([mm, mm // 2])))
    )
    assert len(source) == 2 * room.COUNT
    room.check(source.frame(4), 2)
    np.testing.assert_array_equal(source.frame(5).depth, room.depth_mm(2) // 2)


def test_a_damaged_image_spoils_its_own_frame_only(tmp_path):
    path = database(tmp_path / "walk.db", pack=rvl)
    file = sqlite3.connect(path)
    content = rvl(room.depth_mm(1))
    file.execute("UPDATE Data SET depth = ? WHERE id = 2", (content[: len(content) // 2],))
    file.execute("UPDATE Data SET depth = ? WHERE id = 3", (b"DEPTHRVL" + b"\xff" * 40,))
    file.commit()
    file.close()
    assert [frame.fault for frame in open_source(path)] == [None, "unreadable", "unreadable", None, None]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("UPDATE Data SET depth = NULL", "its 5 nodes hold no depth images"),
        ("UPDATE Admin SET version = '0.10.4'", r"is from RTAB-Map 0\.10\.4"),
        ("DROP TABLE Data", "not a readable RTAB-Map database"),
        ("UPDATE Data SET calibration = x'0102'", "a truncated calibration"),
        ("UPDATE Data SET calibration = zeroblob(44)", "a damaged calibration"),
        ("UPDATE Admin SET opt_poses = x'01020304'", "not a readable RTAB-Map database"),
        ("UPDATE Node SET stamp = 'soon'", "not a readable RTAB-Map database"),
    ],
)
def test_a_database_of_no_use_is_one_line_with_the_cure(tmp_path, change, said):
    path = database(tmp_path / "walk.db")
    file = sqlite3.connect(path)
    file.execute(change)
    file.commit()
    file.close()
    with pytest.raises(SourceError, match=said) as caught:
        open_source(path)
    assert len(str(caught.value).replace(str(tmp_path), "")) <= 200


def test_stereo_pairs_are_no_depth(tmp_path):
    with pytest.raises(SourceError, match=r"walk\.db: holds stereo pairs, not depth; export"):
        open_source(database(tmp_path / "walk.db", calibration=packed(kind=1)))


def test_any_other_file_that_ends_so_is_none(tmp_path):
    (tmp_path / "Thumbs.db").write_bytes(b"\0" * 64)
    with pytest.raises(SourceError, match="is a file, but no recording"):
        open_source(tmp_path / "Thumbs.db")
