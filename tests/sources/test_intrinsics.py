# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from stereovox.descriptions import describe
from stereovox.errors import SourceError
from stereovox.sources.calibration.camera_file import find_camera
from stereovox.sources.calibration.intrinsics import read_camera_numbers, read_intrinsics

DEFAULT = (525.0, 525.0, 319.5, 239.5)


@pytest.mark.parametrize(
    "text",
    [
        "500 0 320\n0 501 240\n0 0 1\n",
        "500 501 320 240",
        "# fx fy cx cy\n500,501,320,240 # pixels\n",
        "\ufeff500 501 320 240",
    ],
)
def test_a_matrix_and_four_numbers_say_the_same(tmp_path, text):
    path = tmp_path / "calibration.txt"
    path.write_text(text, "utf-8")
    assert read_intrinsics(path) == (500, 501, 320, 240)


@pytest.mark.parametrize(
    "text",
    ["", "500 501 320", "500 0.3 320 0 501 240 0 0 1", "500 0 320 0 501 240 0 0 2", "fx fy cx cy", "nan 501 320 240"],
)
def test_anything_else_is_an_error_that_names_the_file(tmp_path, text):
    path = tmp_path / "calibration.txt"
    path.write_text(text)
    with pytest.raises(SourceError, match=r"calibration\.txt"):
        read_intrinsics(path)


def test_the_first_file_counts_and_leaves_no_note(tmp_path):
    near, far = tmp_path / "near", tmp_path / "far"
    near.mkdir()
    far.mkdir()
    (far / "camera-intrinsics.txt").write_text("100 0 2 0 300 4 0 0 1")
    camera, notes = find_camera([near, far], (640, 480), 0.075, DEFAULT)[:2]
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline) == (100, 300, 2, 4, 0.075)
    assert notes == ()
    (near / "calibration.txt").write_text("90 90 9 9")
    camera, (note,) = find_camera([near, far], (640, 480), 0.075, DEFAULT)[:2]
    assert camera.fx == 90
    assert note == f"{far / 'camera-intrinsics.txt'} is not used: {near / 'calibration.txt'} comes first"


def test_a_camera_toml_counts_only_in_the_own_folder_and_is_always_told(tmp_path):
    near = tmp_path / "near"
    near.mkdir()
    (tmp_path / "camera.toml").write_text("this would be an error")
    camera, notes = find_camera([near, tmp_path], (640, 480), 0.075, DEFAULT)[:2]
    assert camera.fx == DEFAULT[0]
    assert f"{tmp_path / 'camera.toml'} is not used: it counts only in the recording's own folder" in notes[1]
    (near / "camera-intrinsics.txt").write_text("90 0 9 0 90 9 0 0 1")
    own = "width = 640\nheight = 480\nfx = 80\nfy = 80\ncx = 7\ncy = 5\n"
    for correction, words in (
        ("", "no depth correction"),
        ("[correction]\nmodel = 'thesis'\ncoefficients = [0, 0, 1]", "depth correction 'thesis'"),
    ):
        (near / "camera.toml").write_text(own + correction)
        camera, notes = find_camera([near, tmp_path], (640, 480), 0.075, DEFAULT)[:2]
        assert camera.fx == 80
        assert notes[0] == f"{near / 'camera.toml'} is used ({words})"
        assert notes[2] == f"{near / 'camera-intrinsics.txt'} is not used: {near / 'camera.toml'} comes first"


def test_without_a_file_only_640x480_has_a_default_and_the_user_is_told(tmp_path):
    camera, (note,) = find_camera([tmp_path], (640, 480), 0.075, DEFAULT)[:2]
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (640, 480, *DEFAULT)
    assert "525" in note
    with pytest.raises(SourceError, match=r"camera-intrinsics\.txt.*320x240"):
        find_camera([tmp_path], (320, 240), 0.075, DEFAULT)


def test_impossible_focal_lengths_name_the_file(tmp_path):
    (tmp_path / "calibration.txt").write_text("0 500 320 240")
    with pytest.raises(SourceError, match=r"calibration\.txt: fx = 0 must be positive$"):
        find_camera([tmp_path], (640, 480), 0.075, DEFAULT)
    (tmp_path / "calibration.txt").write_text("1 500 320 240")
    with pytest.raises(SourceError, match=r"calibration\.txt: fx fy cx cy = 1 500 320 240: a ray 8\d\.\d deg"):
        find_camera([tmp_path], (640, 480), 0.075, DEFAULT)


@pytest.mark.parametrize("text", ["0 480 500 500 320 240", "640 -1 500 500 320 240", "1 PINHOLE 0 480 500 500 320 240"])
def test_a_size_of_no_pixels_is_refused(tmp_path, text):
    (tmp_path / "camera.txt").write_text(text)
    with pytest.raises(SourceError, match="pixels"):
        read_camera_numbers(tmp_path / "camera.txt")


def test_a_matrix_with_a_fourth_column_or_its_last_line_twice(tmp_path):
    for text in ("500 0 320 0\n0 501 240 0\n0 0 1 0\n", "500 0 320\n0 501 240\n0 0 1\n0 0 1\n"):
        (tmp_path / "K.txt").write_text(text)
        assert read_intrinsics(tmp_path / "K.txt") == (500, 501, 320, 240)


ECHO = """header:
  frame_id: camera
height: 480
width: 848
d:
- 0.0
k:
- 421.5
- 0.0
- 424.25
- 0.0
- 420.5
- 238.75
- 0.0
- 0.0
- 1.0
binning_x: 0
roi:
  height: 0
  width: 0
---
"""


@pytest.mark.parametrize("name", ["camera_info.yaml", "echo.txt"])
@pytest.mark.parametrize("times", [1, 3])
def test_what_topic_echo_prints_is_a_camera(tmp_path, name, times):
    (tmp_path / name).write_text(ECHO * times)
    assert read_camera_numbers(tmp_path / name)[:2] == ((421.5, 420.5, 424.25, 238.75), (848, 480))


SEVERAL = {
    "SN123.conf": "[LEFT_CAM_2K]\nfx=1065\nfy=1065\ncx=1117\ncy=628\n[LEFT_CAM_HD]\nfx=532\nfy=532\ncx=640\ncy=360\n",
    "rs.txt": ' Intrinsic of "Depth" / 848x480 / {Z16}\n  Fx: 421\n Intrinsic of "Depth" / 640x480 / {Z16}\n  Fx: 9\n',
    "oak.json": '{"boardName": "OAK-D", "cameraData": [[1, {"intrinsicMatrix": [[8, 0, 6], [0, 8, 4], [0, 0, 1]]}]]}',
    "cut.yaml": ECHO.replace("  height: 0\n  width: 0", "  height: 240\n  width: 320"),
    "binned.yaml": ECHO.replace("binning_x: 0", "binning_x: 2"),
}


@pytest.mark.parametrize("name", SEVERAL)
def test_a_file_of_several_cameras_is_refused_with_the_cure(tmp_path, name):
    """The last of a ZED's sizes was taken for that of any image."""
    (tmp_path / name).write_text(SEVERAL[name])
    for read in (read_camera_numbers, describe):
        with pytest.raises(SourceError, match=r"write .* into K\.txt"):
            read(tmp_path / name)
