# SPDX-License-Identifier: Apache-2.0
"""camera.toml: written, read, found next to recordings, put in the place of a source's own camera."""

from dataclasses import replace

import numpy as np
import pytest
from made_recordings import depth_image, seven_scenes, write_png

from stereovox.cameras.pinhole import DepthCorrection, PinholeCamera
from stereovox.errors import SourceError
from stereovox.opening import open_images, open_source
from stereovox.sources.calibration.camera_file import camera_text, read_camera, with_camera

CORRECTION = DepthCorrection("scale", (0.1, 0, -1e-7, 1 / 3, 0, 2))
CAMERA = PinholeCamera(16, 12, 20.1, 21.2, 7.3, 5.4, 0.05, correction=CORRECTION)
GOOD = "width = 16\nheight = 12\nfx = 20\nfy = 21.5\ncx = 7\ncy = 5\n"


@pytest.mark.parametrize("camera", [CAMERA, replace(CAMERA, baseline=None), replace(CAMERA, correction=None)])
def test_what_is_written_is_read_exactly(tmp_path, camera):
    file = tmp_path / "camera.toml"
    provenance = {"recordings": ['a "quoted\\ name', "sim:wall"], "percent": [0.1, 2], "note": "two\nlines"}
    file.write_text(camera_text(camera, provenance, ("a remark",)), "utf-8")
    assert read_camera(file) == camera


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("width = 16", "height is missing; write height = its number of pixels"),
        (GOOD.replace("cy = 5", ""), "cy is missing; write cy = where the optical axis meets the image"),
        (GOOD.replace("fx = 20", ""), "fx is missing; write fx = its focal length"),
        (GOOD.replace("fx = 20", "fx = -585"), "fx = -585 must be positive$"),
        (GOOD.replace("fx = 20", "fx = 0.1"), "fx fy cx cy = 0.1 21.5 7 5: a ray 89.* deg off the axis"),
        (GOOD + "base_line = 1", "unknown key 'base_line' .did you mean 'baseline'"),
        (GOOD.replace("16", "16.5"), "whole numbers"),
        (GOOD.replace("16", "-3"), "whole numbers"),
        (GOOD.replace("21.5", "'far'"), "fy = 'far' must be a number"),
        (GOOD.replace("21.5", "nan"), "fy = nan must be a number"),
        (GOOD.replace("21.5", "true"), "fy = True must be a number"),
        (GOOD.replace("21.5", "0"), "positive"),
        (GOOD + "baseline = 0", "positive"),
        (GOOD + "correction = 3", "must be a table"),
        (GOOD + "[correction]\nmodel = 'scale'", "coefficients, a list"),
        (GOOD + "[correction]\nmodel = 'scal'\ncoefficients = [1]", "did you mean 'scale'"),
        (GOOD + "[correction]\nmodel = 'scale'\ncoefficients = [1]", "needs 6"),
        (GOOD + "[correction]\nmodel = 'thesis'\ncoefficients = [1, 'a', 2]", "must be numbers"),
        (GOOD + "[correction]\nkind = 'thesis'", "unknown key 'correction.kind'"),
        ("width = ", "correct it"),
        (b"\xff\xfe\x00", "correct it"),
    ],
)
def test_anything_else_is_one_line_with_the_file(tmp_path, text, said):
    file = tmp_path / "camera.toml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SourceError, match=said) as refused:
        read_camera(file)
    assert str(refused.value).startswith(f"{file}: ")
    assert "\n" not in str(refused.value)


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(SourceError, match=r"nothing\.toml"):
        read_camera(tmp_path / "nothing.toml")


def test_in_the_folder_of_a_recording_it_comes_first(tmp_path):
    folder = seven_scenes(tmp_path / "a")  # which has camera-intrinsics.txt
    (folder / "camera.toml").write_text(camera_text(CAMERA))
    source = open_source(folder)
    assert source.camera == source.frame(0).camera == CAMERA
    (folder / "camera.toml").write_text(camera_text(replace(CAMERA, baseline=None)))
    assert open_source(folder).camera.baseline == 0.075, "the data set's own, where the file tells none"
    (folder / "camera.toml").write_text(camera_text(replace(CAMERA, width=32)))
    with pytest.raises(SourceError, match=r"camera\.toml: is for a camera with 32x12 pixels, the images have 16x12"):
        open_source(folder)


def test_another_camera_for_any_source(tmp_path):
    source = open_source(seven_scenes(tmp_path / "a"))
    file = tmp_path / "mine.toml"
    file.write_text(camera_text(replace(CAMERA, baseline=None)))
    other = with_camera(source, file)
    assert other.camera == replace(CAMERA, baseline=0.075)
    assert (other.name, other.length) == (source.name, 4)
    told = f"{file} is used instead of the recording's own camera (depth correction 'scale')"
    assert other.notes == other.after(1).notes == (*source.notes, told)
    frames = list(other)
    assert [frame.camera for frame in frames] == [other.camera] * 4
    np.testing.assert_array_equal(frames[2].depth, source.frame(2).depth)
    assert [frame.stamp_ns for frame in other.after(3)] == [source.frame(3).stamp_ns]
    file.write_text(camera_text(replace(CAMERA, height=13)))
    with pytest.raises(SourceError, match=r"mine\.toml.*16x13.*has 16x12"):
        with_camera(source, file)


def test_images_need_no_poses(tmp_path):
    folder = seven_scenes(tmp_path / "a")
    for file in folder.glob("*.pose.txt"):
        file.unlink()
    assert {frame.fault for frame in open_source(folder)} == {"no_pose"}
    frames = list(open_images(folder, "1:3"))
    assert [frame.fault for frame in frames] == [None, None]
    np.testing.assert_array_equal(frames[0].depth, depth_image(1))
    stamped = tmp_path / "b" / "depth"
    stamped.mkdir(parents=True)
    write_png(stamped / "12.5.png", depth_image(0))
    (stamped.parent / "camera.toml").write_text(camera_text(CAMERA))
    with pytest.raises(SourceError):
        open_source(stamped.parent)
    source = open_images(stamped.parent)
    assert source.camera == CAMERA
    assert [frame.stamp_ns for frame in source] == [12_500_000_000]
    assert open_images("sim:wall?image_width=32").length == 30


def test_a_rig_file_is_named_as_such(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text("[[pair]]\nname = 'front'\n")
    with pytest.raises(SourceError, match="is a rig file, not a camera file"):
        read_camera(path)
