# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import made_rooms as room
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.tartanair import TartanAir

NED_CAMERA = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # optical axes as columns: right, down, forward
NED_WORLD = np.diag([1.0, -1, -1])


def tartanair(folder, side="left", suffix=".npy", count=room.COUNT):
    lines = []
    for k in range(count):
        depth = room.depth_m(k).astype(np.float32)
        image = depth if suffix == ".npy" else depth.view(np.uint8).reshape(*depth.shape, 4)
        room.write(folder / f"depth_{side}" / f"{k:06d}_{side}_depth{suffix}", image)
        T = np.eye(4)
        T[:3, :3] = NED_WORLD @ room.pose(k)[:3, :3] @ NED_CAMERA.T
        T[:3, 3] = NED_WORLD @ room.pose(k)[:3, 3]
        lines.append(room.seven(T))
    (folder / f"pose_{side}.txt").write_text("\n".join(lines) + "\n")
    (folder / "camera-intrinsics.txt").write_text(f"{room.FX} {room.FY} {room.CX} {room.CY}")
    return folder


@pytest.mark.parametrize(("side", "suffix"), [("left", ".npy"), ("lcam_front", ".png")])
def test_frames_are_those_of_the_room_in_a_world_whose_z_points_down(tmp_path, side, suffix):
    source = open_source(tartanair(tmp_path, side, suffix))
    assert isinstance(source, TartanAir)
    assert source.notes == ()
    assert (source.unit.scale, source.unit.sure) == (1.0, True)
    for k, frame in enumerate(source):
        T = np.eye(4)
        T[:3, :3] = NED_WORLD
        frame = type(frame)(frame.depth, frame.camera, T @ frame.T_world_sensor, frame.stamp_ns, frame.depth_scale)
        room.check(frame, k)


def test_without_a_file_the_camera_is_that_of_the_data_set(tmp_path):
    (tartanair(tmp_path) / "camera-intrinsics.txt").unlink()
    camera = open_source(tmp_path).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline) == (32, 32, 32, 24, 0.25)


def test_files_of_other_systems_beside_the_images_do_not_count(tmp_path):
    tartanair(tmp_path)
    (tmp_path / "depth_left/._000000_left_depth.npy").write_bytes(b"Mac OS X")
    assert len(open_source(tmp_path)) == room.COUNT


def test_another_number_of_poses_is_an_error(tmp_path):
    path = tartanair(tmp_path) / "pose_left.txt"
    path.write_text(path.read_text() + "0 0 0 0 0 0 1\n")
    with pytest.raises(SourceError, match=r"pose_left\.txt: holds 6 poses for 5 images"):
        open_source(tmp_path)
