# SPDX-License-Identifier: Apache-2.0
"""`describe` knows every kind of thing, gives the line to type, and ends in one line if there is nothing."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from made_depth import camera_text, matrix_line, posed, render, tum_line, units, write

import stereovox as sv
from stereovox.cli import main
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap


@pytest.fixture
def recording(tmp_path):
    folder = tmp_path / "scan"
    for k, T in enumerate(posed(6)):
        write(folder / f"depth/{k}.png", units(render(T), 1000))
    (folder / "camera-intrinsics.txt").write_text(camera_text())
    (folder / "poses.txt").write_text("".join(matrix_line(T, 3) for T in posed(6)))
    return folder


def test_a_recording(recording):
    found = sv.describe(recording)
    assert found.kind == "recording"
    facts = found.facts
    assert (facts["frames"], facts["width"], facts["height"], facts["fx"]) == (6, 64, 48, 52.0)
    assert (facts["unit"], facts["unit_m"], facts["unit_sure"]) == ("millimetres", 0.001, True)
    assert (facts["posed"], facts["up"]) == (6, "z")
    assert facts["suggested"] == {"max_range": 5.0, "voxel_size": 0.05}
    assert found.commands[0] == f"stereovox map {recording} --out scan.svox"
    json.dumps(facts, allow_nan=False)


def test_images_without_poses_say_what_is_missing_and_what_they_are_good_for(recording):
    (recording / "poses.txt").unlink()
    found = sv.describe(recording)
    assert any("map tracks the camera by visual odometry" in line for line in found.lines)
    assert found.commands[0] == f"stereovox map {recording} --out scan.svox"
    assert "?poses=FILE" in found.commands[1]
    assert (found.facts["posed"], "no poses" in found.facts["missing"]) == (0, True)


def test_the_manifest_of_a_map_is_no_calibration(tmp_path):
    VoxelMap.from_cells(load_config(), [[0, 0, 0]], [2.0]).save(tmp_path / "m.svox")
    with pytest.raises(StereovoxError, match=rf"which is the folder; type: stereovox info {tmp_path}/m\.svox$"):
        sv.describe(tmp_path / "m.svox/manifest.json")
    (tmp_path / "manifest.json").write_text('{"fx": 500, "fy": 500, "cx": 320, "cy": 240}')
    assert sv.describe(tmp_path / "manifest.json").kind == "calibration"


def test_a_map_keeps_its_keys_and_says_which_way_is_up(tmp_path, capsys):
    voxel_map = VoxelMap.from_cells(load_config(up="-y"), [[0, 0, 0]], [2.0])
    voxel_map.save(tmp_path / "m.svox")
    assert main(["info", str(tmp_path / "m.svox"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out.splitlines()[-1])
    kept = {"voxel_size", "bounds", "occupied", "free", "memory_bytes", "frames", "profile", "settings", "changed"}
    assert kept <= set(facts)
    assert (facts["kind"], facts["up"], facts["occupied"]) == ("map", "-y", 1)
    assert facts["commands"][0].startswith("stereovox picture ")


def test_files_of_poses(tmp_path):
    (tmp_path / "way.txt").write_text("".join(tum_line(k, T) for k, T in enumerate(posed(5))))
    (tmp_path / "kitti.txt").write_text("".join(matrix_line(T, 3) for T in posed(5)))
    over_time, one_each = sv.describe(tmp_path / "way.txt"), sv.describe(tmp_path / "kitti.txt")
    assert (over_time.kind, one_each.kind) == ("poses", "poses")
    assert (over_time.facts["poses"], over_time.facts["seconds"]) == (5, 4.0)
    assert one_each.facts["seconds"] is None
    length = sum(np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in zip(posed(5), posed(5)[1:], strict=False))
    assert over_time.facts["path_m"] == pytest.approx(length)
    assert "?poses=" in one_each.commands[0]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera.json", '{"width": 640, "height": 480, "fx": 525, "fy": 526, "cx": 320, "cy": 240}'),
        ("intrinsics.txt", "525 0 320\n0 526 240\n0 0 1\n"),
        ("camera.toml", "width = 640\nheight = 480\nfx = 525\nfy = 526\ncx = 320\ncy = 240\n"),
    ],
)
def test_calibrations_of_one_camera(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    found = sv.describe(tmp_path / name)
    assert found.kind == "calibration"
    assert (found.facts["fx"], found.facts["fy"], found.facts["cx"], found.facts["cy"]) == (525, 526, 320, 240)
    assert "camera" in found.commands[0]


def test_a_profile(tmp_path):
    (tmp_path / "mine.toml").write_text("voxel_size = 0.1\n[sensor]\nmodel = 'andert'\n")
    found = sv.describe(tmp_path / "mine.toml")
    assert found.kind == "settings"
    assert found.facts["settings"]["voxel_size"] == 0.1
    assert "--profile" in found.commands[0]


def test_a_depth_image_and_a_picture(tmp_path):
    write(tmp_path / "d.png", units(render(posed(1)[0]), 1000))
    assert cv2.imwrite(str(tmp_path / "cat.jpg"), np.full((9, 8, 3), 70, np.uint8))
    depth, picture = sv.describe(tmp_path / "d.png"), sv.describe(tmp_path / "cat.jpg")
    assert (depth.kind, depth.facts["width"], depth.facts["dtype"]) == ("depth image", 64, "uint16")
    assert any("millimetres" in line for line in depth.lines)
    assert (picture.kind, picture.facts["width"], picture.facts["height"]) == ("picture", 8, 9)
    assert any("no depth" in line for line in picture.lines)


def test_a_cloud_shows_what_the_import_would_give(tmp_path):
    points = np.stack(np.meshgrid(np.arange(20) / 10, np.arange(20) / 10, [0.0]), axis=-1).reshape(-1, 3)
    np.savetxt(tmp_path / "plane.xyz", points)
    found = sv.describe(tmp_path / "plane.xyz")
    assert found.kind == "cloud"
    assert found.facts["voxel_size"] == sv.import_map(tmp_path / "plane.xyz").voxel_size
    assert found.commands == [f"stereovox import {tmp_path / 'plane.xyz'} plane.svox"]


def test_a_robots_log_and_simulations():
    assert sv.describe("sim:floor").commands[0].startswith("stereovox slam sim:floor")
    assert sv.describe("sim:wall?image_width=160").kind == "recording"


def test_a_folder_with_one_file_that_needs_no_others_is_that_file(tmp_path):
    filled(tmp_path / "notes.txt", b"once upon a time")
    write_floor(tmp_path / "f.yaml")
    assert sv.describe(tmp_path) == sv.describe(tmp_path / "f.yaml")
    assert sv.describe(tmp_path).kind == "floor map"
    write_floor(tmp_path / "g.yaml")
    with pytest.raises(StereovoxError, match=f"not a recording, but 2 files; see each: .* {tmp_path}/f.yaml"):
        sv.describe(tmp_path)


def test_a_folder_that_may_be_a_recording_says_what_is_missing(recording):
    write_floor(recording / "floor.yaml")
    (recording / "camera-intrinsics.txt").unlink()
    with pytest.raises(StereovoxError, match="camera-intrinsics"):
        sv.describe(recording)


@pytest.mark.parametrize(
    "make",
    [
        lambda folder: folder / "gone",
        lambda folder: folder,
        lambda folder: filled(folder / "x.bin", b"\x00\x01" * 99),
        lambda folder: filled(folder / "x", b""),
        lambda folder: filled(folder / "x.png", b"\x89PNG\r\n\x1a\nrest"),
        lambda folder: filled(folder / "x.txt", b"once upon a time"),
        lambda folder: filled(folder / "x.yaml", b"a: [1"),
        lambda folder: filled(folder / "x.toml", b"a = = 1"),
        lambda folder: filled(folder / "x.bag", b"#ROSBAG V2.0\nnothing"),
        lambda folder: filled(folder / "x.ply", b"ply\nnothing"),
    ],
)
def test_what_is_nothing_ends_in_one_line_with_a_cure(tmp_path, make):
    path = make(tmp_path)
    with pytest.raises(StereovoxError) as caught:
        sv.describe(path)
    text = str(caught.value)
    assert str(path) in text
    assert len(text.replace(str(tmp_path), "")) <= 300
    assert f"stereovox info {path}" not in text, "that is what was just typed"


def write_floor(path):
    """Write a floor's map of 4 x 3 cells for map_server."""
    path.with_suffix(".pgm").write_bytes(b"P5\n4 3\n255\n" + bytes([0, 205, 254, 254] * 3))
    path.write_text(
        f"image: {path.stem}.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )


def filled(path, content):
    path.write_bytes(content)
    return path


def test_cells_of_our_own_npz(tmp_path):
    voxel_map = VoxelMap.from_cells(load_config(), [[0, 0, 0], [1, 2, 3]], [1.0, 2.0])
    sv.export(voxel_map, tmp_path / "m.npz")
    found = sv.describe(tmp_path / "m.npz")
    assert (found.kind, found.facts["occupied"]) == ("cloud", voxel_map.counts()["occupied"])


def test_the_depth_image_in_an_npz(tmp_path):
    np.savez(tmp_path / "d.npz", depth=np.full((48, 64), 1500, np.uint16))
    assert sv.describe(tmp_path / "d.npz").kind == "depth image"
