# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_depth import check, posed, render, units, write
from made_recordings import depth_image, pose, seven_scenes, write_png

from stereovox.errors import SourceError
from stereovox.opening import open_source
from stereovox.sources.base import Selection
from stereovox.sources.rgbd.layouts.seven_scenes import SevenScenes

KITCHEN = Path(__file__).resolve().parents[2] / "../shared/data/sevenscenes_redkitchen"


def test_frames_hold_what_the_files_hold(tmp_path):
    source = SevenScenes(seven_scenes(tmp_path / "office"))
    assert (source.name, len(source), source.notes) == ("office", 4, ())
    frame = source.frame(2)
    assert frame.fault is None
    np.testing.assert_array_equal(frame.depth, depth_image(2))
    np.testing.assert_array_equal(frame.T_world_sensor, pose(2))
    assert frame.depth_scale == 0.001
    assert frame.name.endswith("frame-000002.depth.png")
    camera = frame.camera
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (16, 12, 20, 21, 7.5, 5.5)
    assert camera.baseline == 0.075


def test_any_frame_can_be_asked_for_and_no_other(tmp_path):
    source = SevenScenes(seven_scenes(tmp_path))
    assert source.frame(-1).name == source.frame(3).name
    for i in (4, -5):
        with pytest.raises(IndexError):
            source.frame(i)


def test_stamps_are_the_frame_number_at_30_hz_in_order_of_number(tmp_path):
    for n in (1000000, 30, 7):
        write_png(tmp_path / f"frame-{n:06d}.depth.png", depth_image(0))
        np.savetxt(tmp_path / f"frame-{n:06d}.pose.txt", pose(0))
    (tmp_path / "camera-intrinsics.txt").write_text("20 20 7 5")
    stamps = [frame.stamp_ns for frame in SevenScenes(tmp_path)]
    assert stamps == [233_333_333, 1_000_000_000, 33_333_333_333_333]


def test_the_intrinsics_may_lie_one_folder_up(tmp_path):
    seven_scenes(tmp_path / "seq-01", intrinsics=None)
    (tmp_path / "camera-intrinsics.txt").write_text("20 0 7\n0 20 5\n0 0 1")
    assert SevenScenes(tmp_path / "seq-01").camera.cx == 7


def test_without_intrinsics_640x480_gets_the_documented_ones_and_says_so(tmp_path):
    source = open_source(seven_scenes(tmp_path / "a", count=1, intrinsics=None, size=(640, 480)), "0:1")
    camera = source.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (585, 585, 320, 240)
    assert "585" in source.notes[0]


def test_without_intrinsics_other_sizes_cannot_be_opened(tmp_path):
    with pytest.raises(SourceError, match=r"camera-intrinsics\.txt.*16x12"):
        SevenScenes(seven_scenes(tmp_path, intrinsics=None))


@pytest.mark.parametrize(
    ("name", "spoil", "fault"),
    [
        ("frame-000001.depth.png", lambda p: p.unlink(), "missing_file"),
        ("frame-000001.depth.png", lambda p: p.write_bytes(p.read_bytes()[:-20]), "unreadable"),
        ("frame-000001.depth.png", lambda p: p.write_bytes(b""), "unreadable"),
        ("frame-000001.depth.png", lambda p: write_png(p, np.ones((12, 16), np.uint8)), "bad_dtype"),
        ("frame-000001.depth.png", lambda p: write_png(p, depth_image(0, (8, 8))), "bad_shape"),
        ("frame-000001.pose.txt", lambda p: p.unlink(), "no_pose"),
        ("frame-000001.pose.txt", lambda p: p.write_text("1 0 0"), "bad_pose_file"),
        ("frame-000001.pose.txt", lambda p: p.write_text("1 " * 17), "bad_pose_file"),
        ("frame-000001.pose.txt", lambda p: p.write_text("one " * 16), "bad_pose_file"),
        ("frame-000001.pose.txt", lambda p: p.write_bytes(b"\xff\xfe\x00"), "bad_pose_file"),
    ],
)
def test_a_bad_file_spoils_its_own_frame_only(tmp_path, name, spoil, fault, capfd):
    folder = seven_scenes(tmp_path)
    spoil(folder / name)
    before, frame, *after = SevenScenes(folder)
    assert frame.fault == fault
    assert str(folder / name) in frame.fault_detail
    assert "\n" not in frame.fault_detail
    assert frame.depth.shape == (0, 0)
    assert frame.depth.dtype == np.uint16
    assert frame.stamp_ns == 33_333_333
    assert [f.fault for f in (before, *after)] == [None, None, None]
    assert capfd.readouterr() == ("", "")


def test_a_pose_with_nan_is_handed_on_as_it_is(tmp_path):
    folder = seven_scenes(tmp_path)
    (folder / "frame-000000.pose.txt").write_text("nan " * 16)
    frame = SevenScenes(folder).frame(0)
    assert frame.fault is None
    assert np.isnan(frame.T_world_sensor).all()


def test_an_odd_first_image_does_not_set_the_size(tmp_path):
    folder = seven_scenes(tmp_path)
    write_png(folder / "frame-000000.depth.png", depth_image(0, (8, 8)))
    assert [frame.fault for frame in SevenScenes(folder)] == ["bad_shape", None, None, None]


def test_not_one_readable_image_is_an_error(tmp_path):
    folder = seven_scenes(tmp_path)
    for path in folder.glob("*.png"):
        path.write_bytes(b"no")
    with pytest.raises(SourceError, match="none of the 4 depth images"):
        SevenScenes(folder)


def test_other_files_beside_it_are_left_alone(tmp_path):
    folder = seven_scenes(tmp_path)
    for name in ("frame-000009.color.png", "frame-000009.depth.png.part", "xframe-000009.depth.png", "notes.txt"):
        (folder / name).write_bytes(b"?")
    assert len(SevenScenes(folder)) == 4


@pytest.mark.skipif(not KITCHEN.is_dir(), reason="the recording ../shared/data/sevenscenes_redkitchen is absent")
def test_the_kitchen():
    source = open_source(KITCHEN)
    assert len(source) == 200
    first, last = source.frame(0), source.frame(199)
    np.testing.assert_array_equal(first.T_world_sensor, np.loadtxt(KITCHEN / "frame-000000.pose.txt"))
    assert (first.camera.width, first.camera.height, first.camera.fx) == (640, 480, 585)
    assert last.stamp_ns == 995 * 10**9 // 30
    depths = first.depth[(first.depth > 0) & (first.depth < 65535)] * first.depth_scale
    assert 0.5 < np.median(depths) < 4
    assert 0.6 < depths.size / first.depth.size < 1
    assert all(frame.fault is None for frame in open_source(KITCHEN, "::20"))


INFO = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 640
m_colorHeight = 480
m_depthWidth = 64
m_depthHeight = 48
m_depthShift = 4000
m_calibrationColorIntrinsic = 583 0 320 0 0 583 240 0 0 0 1 0 0 0 0 1
m_calibrationColorExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = 52 0 31 0 0 51 24 0 0 0 1 0 0 0 0 1
m_calibrationDepthExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_frames.size = 4
"""


@pytest.mark.parametrize("name", ["info.txt", "_info.txt"])
@pytest.mark.parametrize("suffix", ["png", "pgm"])
def test_bundlefusion_and_3rscan_say_camera_and_unit(tmp_path, name, suffix):
    for k, T in enumerate([*posed(), np.full((4, 4), -np.inf)]):
        seen = posed()[0] if k == 4 else T
        write(tmp_path / f"frame-{k:06d}.depth.{suffix}", units(render(seen), 4000))
        np.savetxt(tmp_path / f"frame-{k:06d}.pose.txt", T)
    (tmp_path / name).write_text(INFO)
    source = SevenScenes(
        tmp_path,
    )
    check(Selection(source, ":4"), posed(), 4000)
    assert source.unit.sure
    assert not np.isfinite(source.frame(4).T_world_sensor).any()  # tracking was lost; the gate refuses it


def test_an_info_txt_of_something_else_is_no_camera(tmp_path):
    folder = seven_scenes(tmp_path)
    (folder / "info.txt").write_text("recorded on a Tuesday\n")
    assert SevenScenes(folder).camera.fx == 20
