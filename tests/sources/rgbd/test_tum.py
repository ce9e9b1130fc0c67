# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from made_recordings import SIZE, depth_image, tum, write_png

from stereovox.errors import SourceError
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.tum import TumRgbd

STAMPS = ["1305031102.160407", "1305031102.194330", "1305031102.226738"]
STRAIGHT = "".join(f"1305031102.{ms:03d} {ms / 1000} 0 1 0 0 0 1\n" for ms in range(100, 300, 10))
"""Poses each 10 ms whose x is the part of their stamp below the second."""


@pytest.mark.parametrize("listed", [True, False])
def test_frames_hold_what_the_files_hold(tmp_path, listed):
    source = TumRgbd(tum(tmp_path / "desk", STAMPS, STRAIGHT, listed))
    assert (source.name, len(source)) == ("desk", 3)
    (note,) = source.notes  # three poses on a line of 0.2 s prove nothing about the unit
    assert "assumed to be in 1/5000 m" in note
    assert "?depth_scale=1000" in note
    for n, frame in enumerate(source):
        assert frame.fault is None
        np.testing.assert_array_equal(frame.depth, depth_image(n))
        assert frame.stamp_ns == int(STAMPS[n].replace(".", "")) * 1000
        np.testing.assert_allclose(frame.T_world_sensor[:3, 3], [float("0." + STAMPS[n][11:]), 0, 1], atol=1e-12)
        assert frame.depth_scale == 1 / 5000
    assert (source.camera.width, source.camera.height) == SIZE
    assert (source.camera.fx, source.camera.baseline) == (20, 0.075)


def test_the_list_may_be_unsorted_and_repeat_itself(tmp_path):
    folder = tum(tmp_path, STAMPS, STRAIGHT)
    lines = [f"{stamp}\tdepth/{stamp}.png" for stamp in reversed(STAMPS)]
    (folder / "depth.txt").write_text("\n".join(["# list", *lines, "", lines[0] + " # again"]))
    source = TumRgbd(folder)
    assert [frame.depth[5, 5] for frame in source] == [depth_image(n)[5, 5] for n in range(3)]
    assert "left out 1 image" in source.notes[0]


def test_images_without_a_pose_nearby_are_faulty_frames(tmp_path):
    early, late = "1305031102.050000", "1305031109.000000"
    frames = list(TumRgbd(tum(tmp_path, [early, *STAMPS, late], STRAIGHT)))
    assert [frame.fault for frame in frames] == ["no_pose", None, None, None, "no_pose"]
    assert f"before {late[:14]}" in frames[-1].fault_detail
    assert frames[0].stamp_ns == 1_305_031_102_050_000_000


def test_a_bad_line_of_poses_spoils_the_frames_that_need_it(tmp_path):
    bad = STRAIGHT.replace("1305031102.190 0.19 0 1 0 0 0 1", "1305031102.190 0.19 0 1 0 0 0 0")
    frames = list(TumRgbd(tum(tmp_path, STAMPS, bad)))
    assert [frame.fault for frame in frames] == [None, "bad_pose_file", None]
    assert "groundtruth.txt:10:" in frames[1].fault_detail
    assert frames[1].depth.shape == (0, 0)


def test_missing_and_broken_images_are_faulty_frames(tmp_path, capfd):
    folder = tum(tmp_path, STAMPS, STRAIGHT)
    first, second = (folder / "depth" / f"{stamp}.png" for stamp in STAMPS[:2])
    first.unlink()
    second.write_bytes(second.read_bytes()[:60])
    frames = list(TumRgbd(folder))
    assert [frame.fault for frame in frames] == ["missing_file", "unreadable", None]
    assert str(first) in frames[0].fault_detail
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("line", ["1305031103.5", "later depth/x.png"])
def test_a_bad_line_of_the_list_names_file_and_line(tmp_path, line):
    folder = tum(tmp_path, STAMPS, STRAIGHT)
    (folder / "depth.txt").write_text(f"# list\n{line}\n")
    with pytest.raises(SourceError, match=r"depth\.txt:2: "):
        TumRgbd(folder)


def test_an_image_whose_name_is_no_time_is_an_error(tmp_path):
    folder = tum(tmp_path, STAMPS, STRAIGHT, listed=False)
    write_png(folder / "depth" / "first.png", depth_image(0))
    with pytest.raises(SourceError, match=r"first\.png.*not a time"):
        TumRgbd(folder)


def test_no_image_at_all_is_an_error(tmp_path):
    folder = tum(tmp_path, [], STRAIGHT)
    with pytest.raises(SourceError, match="name no image"):
        TumRgbd(folder)


def test_without_intrinsics_640x480_gets_tums_own_and_says_so(tmp_path):
    folder = tum(tmp_path, STAMPS, STRAIGHT, intrinsics=None)
    with pytest.raises(SourceError, match=r"camera-intrinsics\.txt"):
        TumRgbd(folder)
    for stamp in STAMPS:
        write_png(folder / "depth" / f"{stamp}.png", depth_image(0, (640, 480)))
    source = TumRgbd(folder)
    assert (source.camera.fx, source.camera.fy, source.camera.cx, source.camera.cy) == (525, 525, 319.5, 239.5)
    assert "525" in source.notes[0]
    (folder / "calibration.txt").write_text("517.3 516.5 318.6 255.3")
    assert TumRgbd(folder).camera.fx == 517.3


@pytest.mark.parametrize("name", ["CameraTrajectory.txt", "KeyFrameTrajectory.txt", "truth_cam_poses.txt"])
def test_without_groundtruth_the_poses_of_a_slam_program_are_used_and_named(tmp_path, name):
    folder = tum(tmp_path, STAMPS, STRAIGHT)
    (folder / "groundtruth.txt").rename(folder / name)
    (folder / "a_trajectory_notes.txt").write_text("walked slowly\n")
    source = open_source(folder)
    assert isinstance(source, TumRgbd)
    assert [frame.fault for frame in source] == [None] * 3
    assert source.frame(1).T_world_sensor[0, 3] == pytest.approx(0.19433)
    assert f"using poses of {name}" in source.notes[0]
    (folder / "groundtruth.txt").write_text(STRAIGHT)
    assert not any(name in note for note in open_source(folder).notes)


def test_poses_may_be_one_for_each_image_where_the_clocks_differ(tmp_path):
    folder = tum(tmp_path, STAMPS, STRAIGHT)
    (folder / "groundtruth.txt").unlink()
    (folder / "CameraTrajectory.txt").write_text("".join(f"{k}.5 {k} 0 0 0 0 0 1\n" for k in range(3)))
    assert [frame.T_world_sensor[0, 3] for frame in open_source(folder)] == [0, 1, 2]
    (folder / "CameraTrajectory.txt").write_text("0.5 0 0 0 0 0 0 1\n1.5 0 0 0 0 0 0 1\n")
    with pytest.raises(SourceError, match="2 poses for 3 images"):
        open_source(folder)


@pytest.mark.parametrize("line", ["{0}1 rgb/x.png {0} depth/{0}.png\n", "{0} depth/{0}.png {0}1 rgb/x.png\n"])
def test_a_list_of_pairs_names_the_depth_images(tmp_path, line):
    folder = tum(tmp_path, STAMPS, STRAIGHT, listed=False)
    (folder / "associations.txt").write_text("".join(line.format(stamp) for stamp in STAMPS[:2]))
    source = open_source(folder)
    assert [frame.depth[5, 5] for frame in source] == [depth_image(n)[5, 5] for n in range(2)]
    assert source.frame(0).stamp_ns == 1_305_031_102_160_407_000
    (folder / "associations.txt").write_text("1.0 depth/a.png 2.0\n")
    with pytest.raises(SourceError, match=r"associations\.txt:1: needs"):
        open_source(folder)


def test_a_folder_without_poses_names_them_as_what_is_missing(tmp_path):
    folder = tum(tmp_path, STAMPS, STRAIGHT)
    (folder / "groundtruth.txt").unlink()
    with pytest.raises(SourceError, match=r"but no poses; write poses\.txt .*\?poses=FILE"):
        open_source(folder)


def test_bonns_camera_and_the_only_yaml(tmp_path):
    folder = tum(tmp_path / "rgbd_bonn_crowd", STAMPS, STRAIGHT, intrinsics=None)
    for stamp in STAMPS:
        write_png(folder / "depth" / f"{stamp}.png", depth_image(0, (640, 480)))
    assert TumRgbd(folder).camera.fx == 542.822841
    yaml = "%YAML:1.0\nCamera.fx: 535.4\nCamera.fy: 539.2\nCamera.cx: 320.1\nCamera.cy: 247.6\nDepthMapFactor: 1000.0\n"
    (folder / "TUM3.yaml").write_text(yaml)
    source = TumRgbd(folder)
    assert (source.camera.fx, source.depth_scale) == (535.4, 0.001)
    (folder / "another.yaml").write_text(yaml)
    assert TumRgbd(folder).camera.fx == 542.822841
