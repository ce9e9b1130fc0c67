# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import made_rooms as room
import pytest

from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.rtabmap import RtabmapExport

STAMPS = [f"{1600000000 + k}.250000" for k in range(room.COUNT)]


def calibration(fx=10 * room.FX):
    cx, cy = (10 * (centre + 0.5) - 0.5 for centre in (room.CX, room.CY))
    numbers = [fx, 0, cx, 0, 0, 10 * room.FY, cy, 0, 0, 0, 1, 0]
    entries = {"projection_matrix": (3, 4, numbers), "local_transform": (3, 4, room.T_BASE_CAMERA[:3].ravel().tolist())}
    lines = ["%YAML:1.0", "---", "image_width: 640", "image_height: 480"]
    for key, (rows, columns, data) in entries.items():
        lines += [f"{key}:", f"   rows: {rows}", f"   cols: {columns}", f"   data: {data}"]
    return "\n".join(lines) + "\n"


def exported(folder, names=STAMPS, ids=True, base=False):
    lines = ["#timestamp x y z qx qy qz qw id"]
    for k, name in enumerate(names):
        room.write(folder / f"rtabmap_depth/{name}.png", room.depth_mm(k))
        path = folder / f"rtabmap_calib/{name}.yaml"
        path.parent.mkdir(exist_ok=True)
        path.write_text(calibration())
        T = room.pose(k) @ inverse(room.T_BASE_CAMERA) if base else room.pose(k)
        lines.append(f"{STAMPS[k]} {room.seven(T)}" + (f" {k + 7}" if ids else ""))
    name = "rtabmap_poses.txt" if base else "rtabmap_camera_poses.txt"
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("ids", [True, False])
@pytest.mark.parametrize("base", [True, False])
def test_frames_are_those_of_the_room(tmp_path, ids, base):
    source = open_source(exported(tmp_path, ids=ids, base=base))
    assert isinstance(source, RtabmapExport)
    assert source.notes == ()
    for k, frame in enumerate(source):
        room.check(frame, k)
        assert frame.stamp_ns == (1600000000 + k) * 10**9 + 250_000_000


def test_images_named_by_node_are_found_by_it(tmp_path):
    for k, frame in enumerate(open_source(exported(tmp_path, [str(k + 7) for k in range(room.COUNT)]))):
        room.check(frame, k)


def test_each_image_has_its_own_camera(tmp_path):
    exported(tmp_path)
    (tmp_path / f"rtabmap_calib/{STAMPS[1]}.yaml").write_text(calibration(510.0))
    assert [frame.camera.fx for frame in open_source(tmp_path)] == [50, 51, 50, 50, 50]


def test_an_image_without_a_line_has_no_pose(tmp_path):
    path = exported(tmp_path) / "rtabmap_camera_poses.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:-1]))
    frames = list(open_source(tmp_path))
    assert [frame.fault for frame in frames] == [None] * 4 + ["bad_pose_file"]
    assert "has no line for" in frames[-1].fault_detail


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("rtabmap_camera_poses.txt", "1 0 0 1 0 0 1 0 0 0 1 0\n", "has 12 numbers.*rtabmap-export"),
        ("rtabmap_camera_poses.txt", "1 a 0 0 0 0 0 1\n", r"poses\.txt:1: could not"),
        (f"rtabmap_calib/{STAMPS[0]}.yaml", "image_width: 640\n", "neither projection_matrix nor camera_matrix"),
        (f"rtabmap_calib/{STAMPS[0]}.yaml", calibration(10**9), "fx fy cx cy = 1e"),
    ],
)
def test_a_bad_file_is_one_line_with_its_name(tmp_path, name, text, said):
    (exported(tmp_path) / name).write_text(text)
    with pytest.raises(SourceError, match=said) as caught:
        open_source(tmp_path)
    assert name in str(caught.value)
