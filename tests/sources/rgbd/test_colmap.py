# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct

import made_rooms as room
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.colmap import Colmap

UNIT = 0.4
"""Metres of COLMAP's unit in these models."""
PINHOLE = 1, "PINHOLE", 64, 48, (room.FX, room.FY, room.CX + 0.5, room.CY + 0.5)
CODES = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "OPENCV_FISHEYE": 5}


def posed(k):
    """qw qx qy qz tx ty tz of the world in the camera, in COLMAP's unit."""
    T = inverse(room.pose(k))
    x, y, z, w = room.quaternion(T)
    return [w, x, y, z, *(T[:3, 3] / UNIT)]


def points(k, count=40):
    """Points of image k: columns and rows, and where they are, in COLMAP's unit."""
    rng = np.random.default_rng(k)
    u, v = rng.integers(4, 60, count), rng.integers(4, 44, count)
    z = room.depth_m(k)[v, u]
    T, at = room.pose(k), np.stack([(u - room.CX) / room.FX * z, (v - room.CY) / room.FY * z, z], 1)
    return np.stack([u, v], 1) + 0.5, (at @ T[:3, :3].T + T[:3, 3]) / UNIT


def text_model(folder, camera=PINHOLE, seen=True):
    folder.mkdir(parents=True)
    number, model, width, height, numbers = camera
    (folder / "cameras.txt").write_text(f"# cameras\n{number} {model} {width} {height} {' '.join(map(str, numbers))}\n")
    images, cloud = ["# images"], ["# points"]
    for k in range(room.COUNT):
        pixels, places = points(k)
        images.append(f"{k + 1} {' '.join(map(str, posed(k)))} {number} frame{k}.jpg")
        numbers = range(100 * k, 100 * k + len(pixels))
        images.append(" ".join(f"{u} {v} {n}" for (u, v), n in zip(pixels, numbers, strict=True)) if seen else "")
        cloud += [f"{n} {x} {y} {z} 0 0 0 0.5 1 0" for n, (x, y, z) in zip(numbers, places, strict=True) if seen]
    (folder / "images.txt").write_text("\n".join(images) + "\n")
    (folder / "points3D.txt").write_text("\n".join(cloud) + "\n")


def binary_model(folder, camera=PINHOLE):
    folder.mkdir(parents=True)
    number, model, width, height, numbers = camera
    head = struct.pack("<QiiQQ", 1, number, CODES[model], width, height)
    (folder / "cameras.bin").write_bytes(head + struct.pack(f"<{len(numbers)}d", *numbers))
    images, cloud, count = struct.pack("<Q", room.COUNT), b"", 0
    for k in range(room.COUNT):
        pixels, places = points(k)
        images += struct.pack("<i7di", k + 1, *posed(k), number) + f"frame{k}.jpg".encode() + b"\0"
        images += struct.pack("<Q", len(pixels) + 1) + struct.pack("<ddq", 1.0, 1.0, -1)
        for (u, v), place in zip(pixels, places, strict=True):
            images += struct.pack("<ddq", u, v, count)
            cloud += struct.pack("<Q3d3BdQii", count, *place, 0, 0, 0, 0.5, 1, k + 1, 0)
            count += 1
    (folder / "images.bin").write_bytes(images)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", count) + cloud)


def sensor_depth(folder):
    for k in range(room.COUNT):
        room.write(folder / f"depth/frame{k}.png", room.depth_mm(k))
    return folder


@pytest.mark.parametrize(
    ("place", "write"), [("sparse/0", text_model), ("sparse", binary_model), ("colmap/sparse/0", text_model)]
)
def test_with_a_depth_camera_the_map_is_in_metres(tmp_path, place, write):
    write(sensor_depth(tmp_path) / place)
    source = open_source(tmp_path)
    assert isinstance(source, Colmap)
    (note,) = source.notes
    assert "poses are scaled by 0.4," in note
    for k, frame in enumerate(source):
        room.check(frame, k)


def test_another_unit_of_depth_gives_the_same_map_where_it_is_told(tmp_path):
    text_model(tmp_path / "sparse")
    for k in range(room.COUNT):
        room.write(tmp_path / f"depth/frame{k}.png", np.rint(5000 * room.depth_m(k)).astype(np.uint16))
    for k, frame in enumerate(open_source(f"{tmp_path}?depth_scale=5000")):
        room.check(frame, k)


def test_own_depth_maps_are_in_the_unit_of_the_poses(tmp_path):
    text_model(tmp_path / "dense/sparse")
    for k in range(room.COUNT):
        for kind, factor in (("geometric", 1 / UNIT), ("photometric", 7.0)):
            path = tmp_path / f"dense/stereo/depth_maps/frame{k}.jpg.{kind}.bin"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"64&48&1&" + (factor * room.depth_m(k)).astype("<f4").tobytes())
    source = open_source(tmp_path)
    assert "COLMAP's own unit" in source.notes[0]
    for k, frame in enumerate(source):
        np.testing.assert_allclose(frame.depth * frame.depth_scale, room.depth_m(k) / UNIT, rtol=1e-6)
        np.testing.assert_allclose(frame.T_world_sensor[:3, 3], room.pose(k)[:3, 3] / UNIT, atol=1e-6)
    path.write_bytes(path.read_bytes()[:-4])
    path.with_name(f"frame{k}.jpg.geometric.bin").unlink()
    assert open_source(tmp_path).frame(-1).fault == "unreadable"


def test_without_points_the_scale_is_said_to_be_unknown(tmp_path):
    text_model(sensor_depth(tmp_path) / "sparse", seen=False)
    assert "COLMAP's unit could not be found: 0 points" in open_source(tmp_path).notes[0]


def test_points_that_do_not_fit_the_depth_give_no_scale(tmp_path):
    text_model(tmp_path / "sparse")
    rng = np.random.default_rng(0)
    for k in range(room.COUNT):
        room.write(tmp_path / f"depth/frame{k}.png", rng.integers(500, 9000, (48, 64)).astype(np.uint16))
    assert "depths do not fit" in open_source(tmp_path).notes[0]


def test_images_without_depth_are_left_out_and_counted(tmp_path):
    text_model(sensor_depth(tmp_path) / "sparse")
    (tmp_path / "depth/frame2.png").unlink()
    source = open_source(tmp_path)
    assert len(source) == room.COUNT - 1
    assert "1 images have no depth image" in source.notes[0]


def test_a_model_alone_says_what_is_missing(tmp_path):
    text_model(tmp_path / "sparse/0")
    with pytest.raises(
        SourceError, match=r"has COLMAP poses \(1\) but no depth images; put one for each image"
    ) as said:
        open_source(tmp_path)
    assert len(str(said.value).replace(str(tmp_path), "")) <= 200


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        ((1, "OPENCV_FISHEYE", 64, 48, (50, 50, 32, 24, 0, 0, 0, 0)), "OPENCV_FISHEYE camera; undistort"),
        ((1, "PINHOLE", 640, 640, (500, 500, 320, 320)), "is for 640x640 images, depth has 64x48"),
        ((1, "PINHOLE", 64, 48, (50, -50, 32, 24)), "fy = -50 must be positive"),
        ((1, "PINHOLE", 64, 48, ("x", 50, 32, 24)), "is damaged"),
        ((2, "PINHOLE", 64, 48, (50, 50)), "a PINHOLE camera"),
        ((1, "PINHOLE", 64, 0, (50, 50, 32, 24)), "a camera of 64x0 pixels"),
    ],
)
def test_a_camera_of_no_use_is_one_line(tmp_path, camera, said):
    text_model(sensor_depth(tmp_path) / "sparse", camera)
    with pytest.raises(SourceError, match=said):
        open_source(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_cut_off_model_is_one_line(tmp_path, name):
    binary_model(sensor_depth(tmp_path) / "sparse")
    path = tmp_path / f"sparse/{name}.bin"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(SourceError, match=rf"{name}\.bin: is damaged"):
        open_source(tmp_path)
