# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import cv2
import made_rooms as room
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.nerfstudio import NerfTransforms

OPENGL = np.diag([1.0, -1, -1, 1])
CAMERA = {"fl_x": 500.0, "fl_y": 520.0, "cx": 310.0, "cy": 250.0, "w": 640, "h": 480, "camera_model": "OPENCV"}
"""That of the room in pictures ten times as large, whose first pixel begins at 0."""


def nerf(folder, write=room.depth_mm, **extra):
    frames = []
    for k in range(room.COUNT):
        room.write(folder / f"depths/frame_{k:05d}.png", write(k))
        matrix = (room.pose(k) @ OPENGL).tolist()
        names = {"file_path": f"images/frame_{k:05d}.jpg", "depth_file_path": f"depths/frame_{k:05d}.png"}
        frames.append({**names, "transform_matrix": matrix})
    save(folder, {**CAMERA, **extra, "frames": frames})
    return folder


def save(folder, table):
    (folder / "transforms.json").write_text(json.dumps(table))


def load(folder):
    return json.loads((folder / "transforms.json").read_text())


def test_frames_are_those_of_the_room(tmp_path):
    source = open_source(nerf(tmp_path))
    assert isinstance(source, NerfTransforms)
    assert source.notes == ()
    assert source.unit.sure
    for k, frame in enumerate(source):
        room.check(frame, k)


def test_each_frame_may_have_a_camera_and_frames_may_be_in_any_order(tmp_path):
    table = load(nerf(tmp_path))
    for key in CAMERA:
        for frame in table["frames"]:
            frame[key] = table[key]
    table["frames"][2]["fl_x"] = 505.0
    save(tmp_path, {"frames": table["frames"][::-1]})
    focal = [frame.camera.fx for frame in open_source(tmp_path)]
    np.testing.assert_allclose(focal, [50, 50, 50.5, 50, 50])


def test_instant_ngp_names_depth_otherwise_and_tells_the_unit_and_the_angle(tmp_path):
    table = load(nerf(tmp_path, lambda k: np.rint(5000 * room.depth_m(k)).astype(np.uint16)))
    for frame in table["frames"]:
        frame["depth_path"] = frame.pop("depth_file_path").removesuffix(".png")
    angle = 2 * np.arctan(32 / room.FX)
    save(tmp_path, {"camera_angle_x": angle, "integer_depth_scale": 1 / 5000, "frames": table["frames"]})
    source = open_source(tmp_path)
    assert source.frame(0).depth_scale == 1 / 5000
    assert source.camera.fx == pytest.approx(room.FX)
    assert (source.camera.cx, source.camera.cy) == (31.5, 23.5)


def test_the_applied_scale_is_undone(tmp_path):
    table = load(nerf(tmp_path, applied_scale=0.1))
    for frame in table["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= 0.1
    save(tmp_path, table)
    room.check(open_source(tmp_path).frame(4), 4)


def test_depth_of_a_lens_that_distorts_is_undistorted(tmp_path):
    K = np.array([[room.FX, 0, room.CX], [0, room.FY, room.CY], [0, 0, 1]])
    k1 = -0.2
    v, u = np.mgrid[:48, :64].astype(float)
    straight = cv2.undistortPoints(np.stack([u.ravel(), v.ravel()], 1), K, np.array([k1, 0, 0, 0]), P=K)
    columns, rows = (straight[:, 0, n].reshape(48, 64) for n in range(2))

    def distorted(k):
        return np.rint(1000 * room.depth_m(k, columns, rows)).astype(np.uint16)

    source = open_source(nerf(tmp_path, distorted, k1=k1))
    assert "depth is undistorted" in source.notes[0]
    seen = source.frame(1).depth / 1000
    off = np.abs(seen - room.depth_m(1))[seen > 0]
    assert np.mean(seen > 0) > 0.8
    assert np.median(off) < 0.02
    assert np.median(np.abs(distorted(1) / 1000 - room.depth_m(1))[seen > 0]) > 2 * np.median(off)


def test_frames_without_depth_are_left_out_and_counted(tmp_path):
    table = load(nerf(tmp_path))
    del table["frames"][1]["depth_file_path"]
    save(tmp_path, table)
    source = open_source(tmp_path)
    assert len(source) == room.COUNT - 1
    assert "1 frames have no depth image" in source.notes[0]


def test_a_recording_without_any_depth_says_so(tmp_path):
    table = load(nerf(tmp_path))
    for frame in table["frames"]:
        del frame["depth_file_path"]
    save(tmp_path, table)
    with pytest.raises(SourceError, match="none of its 5 frames has a depth image") as caught:
        NerfTransforms(tmp_path)
    assert len(str(caught.value).replace(str(tmp_path), "")) <= 200
    for path in (tmp_path / "depths").iterdir():
        path.unlink()
    with pytest.raises(SourceError, match=r"has transforms\.json \(1\) but no depth images; stereovox needs depth"):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE camera; undistort"),
        ({"k4": 0.1}, "k4 belongs to a fisheye"),
        ({"fl_x": None}, "has no fl_x"),
        ({"fl_x": -3}, "fx = -0.3 must be positive"),
        ({"w": 100}, "is for 100x480 pictures, depth has 64x48"),
        ({"frames": []}, "no list of frames"),
        ({"frames": [{"depth_file_path": "../x.png"}]}, "leads out of the recording's folder"),
        ({"frames": [{"depth_file_path": "depths/frame_00000.png", "transform_matrix": [1]}]}, "is not a 4x4 matrix"),
    ],
)
def test_a_bad_file_is_one_line_with_its_name(tmp_path, change, said):
    save(tmp_path, {**load(nerf(tmp_path)), **change})
    with pytest.raises(SourceError, match=said) as caught:
        NerfTransforms(tmp_path)
    assert "transforms.json" in str(caught.value)


def test_a_cut_off_file(tmp_path):
    path = nerf(tmp_path) / "transforms.json"
    path.write_text(path.read_text()[:-20])
    with pytest.raises(SourceError, match="not valid JSON"):
        open_source(tmp_path)
