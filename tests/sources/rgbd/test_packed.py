# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from made_depth import SMALL, VGA, K, camera_text, check, left_handed, posed, sens, slambench_raw, tum_line

from stereovox.errors import SourceError
from stereovox.opening import open_images, open_source
from stereovox.sources.rgbd.layouts.icl_nuim import INTRINSICS
from stereovox.sources.rgbd.packed import SensFile, SlambenchRaw


@pytest.mark.parametrize("code", [0, 1])
def test_sens_holds_camera_unit_poses_and_depth(tmp_path, code):
    path = sens(tmp_path / "scene0000_00/scene0000_00.sens", posed(), code)
    for where in (path, path.parent):
        source = open_source(where)
        assert isinstance(source, SensFile)
        check(source, posed(), 1000)
        assert (source.camera.cx, source.camera.cy, source.notes) == (*K[2:], ())
        assert [frame.stamp_ns for frame in source][:2] == [0, 33_333_333]


def test_sens_says_its_unit(tmp_path):
    check(open_source(sens(tmp_path / "a.sens", posed(), shift=4000.0)), posed(), 4000)


def test_frames_whose_tracking_was_lost_have_no_pose(tmp_path):
    lost = [*posed(3), np.full((4, 4), -np.inf)]
    source = open_source(sens(tmp_path / "a.sens", lost))
    assert [frame.fault for frame in source] == [None, None, None, "no_pose"]
    assert "tracking was lost in frame 3" in source.frame(3).fault_detail


def test_a_sens_that_ends_early_keeps_its_whole_frames(tmp_path):
    path = sens(tmp_path / "a.sens", posed(), 0)
    path.write_bytes(path.read_bytes()[:-200])
    source = open_source(path)
    check(source, posed(3), 1000)
    assert "ends after 3 of 4 frames" in source.notes[0]


def test_a_damaged_frame_of_a_sens_is_a_fault(tmp_path):
    path = sens(tmp_path / "a.sens", posed(2), 1)
    data = bytearray(path.read_bytes())
    at = data.rindex(b"jpg") + 3
    data[at + 20 : at + 60] = bytes(40)
    path.write_bytes(data)
    assert [frame.fault for frame in open_source(path)] == [None, "unreadable"]


def test_a_frame_that_swells_is_not_unpacked_whole(tmp_path):
    path = sens(tmp_path / "a.sens", posed(1), 1)
    header = path.read_bytes()[: 4 + 8 + 15 + 256 + 24 + 12]
    bomb = zlib.compress(bytes(50_000_000))
    frame = np.eye(4, dtype="<f4").tobytes() + struct.pack("<4Q", 0, 0, 0, len(bomb)) + bomb
    path.write_bytes(header + frame)
    (found,) = list(open_source(path))
    assert found.fault == "unreadable"


@pytest.mark.parametrize(
    ("at", "value", "words"),
    [
        (0, b"\5", "version 4"),
        (12 + 15 + 256 + 4, b"\2", "packed as occi"),
        (12 + 15 + 256 + 16, b"\xff\xff\xff\xff", "declares"),
        (12 + 15 + 128, b"\0\0\xc0\x7f", "camera is NaN"),
        (12 + 15 + 128, b"\0\0\0\0", "must be positive"),
    ],
)
def test_a_bad_header_is_named(tmp_path, at, value, words):
    path = sens(tmp_path / "a.sens", posed(1))
    data = bytearray(path.read_bytes())
    data[at : at + len(value)] = value
    path.write_bytes(data)
    with pytest.raises(SourceError, match=words):
        open_source(path)
    path.write_bytes(data[:40])
    with pytest.raises(SourceError):
        open_source(path)


def test_a_sens_may_get_another_camera_and_other_poses(tmp_path):
    path = sens(tmp_path / "a.sens", posed())
    (tmp_path / "k.txt").write_text("60 60 31.5 23.5")
    (tmp_path / "p.txt").write_text("".join(tum_line(k, np.eye(4)) for k in range(4)))
    source = open_source(f"{path}?camera=k.txt&poses=p.txt&fps=10")
    assert (source.camera.fx, source.frame(3).stamp_ns) == (60, 300_000_000)
    np.testing.assert_array_equal(source.frame(2).T_world_sensor, np.eye(4))


def test_slambench_raw_with_icl_nuims_poses(tmp_path):
    path = slambench_raw(tmp_path / "living_room_traj2_loop.raw", posed(3), VGA, INTRINSICS)
    (tmp_path / "livingRoom2.gt.freiburg").write_text(
        "".join(tum_line(k, left_handed(T)) for k, T in enumerate(posed(3)))
    )
    source = open_source(path)
    assert isinstance(source, SlambenchRaw)
    check(source, posed(3), 1000, INTRINSICS)


def test_slambench_raw_with_poses_of_ones_own(tmp_path):
    path = slambench_raw(tmp_path / "walk.raw", posed(), SMALL, K)
    with pytest.raises(SourceError, match=r"has no poses.*\?poses=FILE"):
        open_source(path)
    (tmp_path / "camera-intrinsics.txt").write_text(camera_text())
    (tmp_path / "own.txt").write_text("".join(tum_line(k, T) for k, T in enumerate(posed(), 1)))
    check(open_source(f"{path}?poses=own.txt"), posed(), 1000)
    path.write_bytes(path.read_bytes()[:-7])
    (tmp_path / "own.txt").write_text("".join(tum_line(1e9 + k, T) for k, T in enumerate(posed())))
    with pytest.raises(SourceError, match="4 poses for 3 images"):
        open_source(f"{path}?poses=own.txt")


def test_any_other_raw_file_is_not_taken_for_one(tmp_path):
    (tmp_path / "photo.raw").write_bytes(bytes(range(256)) * 100)
    assert not SlambenchRaw.recognises(str(tmp_path / "photo.raw"))
    with pytest.raises(SourceError, match="no recording that is known"):
        open_source(tmp_path / "photo.raw")


def test_images_alone_need_no_poses(tmp_path):
    path = slambench_raw(tmp_path / "walk.raw", posed(2), SMALL, K)
    (tmp_path / "camera-intrinsics.txt").write_text(camera_text())
    frames = list(open_images(path))
    assert [frame.fault for frame in frames] == [None, None]
    assert np.isnan(frames[0].T_world_sensor).all()
