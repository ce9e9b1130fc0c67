# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import made_rooms as room
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.stray_scanner import StrayScanner

HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
FACTOR = 1920 / room.SIZE[0]


def stray(folder):
    lines = []
    for k in range(room.COUNT):
        room.write(folder / f"depth/{k:06d}.png", room.depth_mm(k))
        room.write(folder / f"confidence/{k:06d}.png", np.full((48, 64), 2, np.uint8))
        lines.append(f"{100 + 0.1 * k:.3f}, {k:06d}, {room.seven(room.pose(k)).replace(' ', ', ')}\n")
    (folder / "odometry.csv").write_text(HEADER + "".join(lines))
    cx, cy = (FACTOR * (centre + 0.5) - 0.5 for centre in (room.CX, room.CY))
    (folder / "camera_matrix.csv").write_text(f"{FACTOR * room.FX}, 0, {cx}\n0, {FACTOR * room.FY}, {cy}\n0, 0, 1\n")
    return folder


def test_frames_are_those_of_the_room(tmp_path):
    source = open_source(stray(tmp_path))
    assert isinstance(source, StrayScanner)
    assert len(source) == room.COUNT
    for k, frame in enumerate(source):
        room.check(frame, k)
        assert frame.stamp_ns == 100_000_000_000 + k * 100_000_000
    assert "1920 columns" in source.notes[0]
    assert source.unit.sure


def test_pixels_of_low_confidence_have_no_value(tmp_path):
    stray(tmp_path)
    confidence = np.full((48, 64), 1, np.uint8)
    confidence[3, 4] = 0
    room.write(tmp_path / "confidence/000001.png", confidence)
    depth = open_source(tmp_path).frame(1).depth
    assert np.argwhere(depth == 0).tolist() == [[3, 4]]


def test_an_image_of_confidence_of_another_size_refuses_its_frame_only(tmp_path):
    stray(tmp_path)
    room.write(tmp_path / "confidence/000001.png", np.ones((24, 32), np.uint8))
    frames = list(open_source(tmp_path))
    assert [frame.fault for frame in frames] == [None, "bad_shape", None, None, None]
    assert "confidence" in frames[1].fault_detail


def test_images_without_a_line_have_no_pose(tmp_path):
    path = stray(tmp_path) / "odometry.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:3] + lines[4:]))
    source = open_source(tmp_path)
    assert [frame.fault for frame in source] == [None, None, "bad_pose_file", None, None]
    assert "no line for 1 images" in source.notes[0]


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("odometry.csv", "", "first line must name the columns"),
        ("odometry.csv", HEADER, "holds no pose"),
        ("odometry.csv", HEADER + "soon, 000000, 0, 0, 0, 0, 0, 0, 1\n", r"odometry\.csv:2: 'soon'"),
        ("odometry.csv", HEADER + "1.0, 000000, 0, 0\n", r"odometry\.csv:2: "),
        ("camera_matrix.csv", "1500, 0, 5000\n0, 1500, 700\n0, 0, 1\n", "not the middle of a usual picture"),
        ("camera_matrix.csv", "1500, 0, 960\n0, 1500, 1400\n0, 0, 1\n", "cy = 1400"),
    ],
)
def test_a_bad_file_is_one_line_with_its_name(tmp_path, name, text, said):
    (stray(tmp_path) / name).write_text(text)
    with pytest.raises(SourceError, match=said) as caught:
        open_source(tmp_path)
    assert name in str(caught.value)
    assert len(str(caught.value).replace(str(tmp_path), "")) <= 250
