# SPDX-License-Identifier: Apache-2.0
"""The unit of depth images is found where the camera moves, and said not to be certain where it does not."""

from __future__ import annotations

import json

import numpy as np
import pytest
from made_depth import K, camera_text, matrix_line, posed, render, tum_line, units, write
from made_recordings import write_png

from stereovox.geometry.se3 import rotation_matrix
from stereovox.opening import open_images, open_source
from stereovox.sources.rgbd.depth_unit import UNITS, find_unit, pairs_of

COUNT = 8


def turned(k: int) -> np.ndarray:
    """A camera that turns where it stands."""
    T = posed(1)[0]
    T[:3, :3] = rotation_matrix([0, 0, 0.1 * k]) @ T[:3, :3]
    return T


def recording(folder, per_metre, layout="tum", poses=None, noise=0.0):
    poses = posed(COUNT) if poses is None else poses
    rng = np.random.default_rng(7)
    for k, T in enumerate(poses):
        depth = render(T) * (1 + noise * rng.normal(size=render(T).shape))
        write(folder / f"depth/{k}.0.png", units(depth, per_metre))
    (folder / "camera-intrinsics.txt").write_text(camera_text())
    if layout == "tum":
        (folder / "groundtruth.txt").write_text("".join(tum_line(f"{k}.0", T) for k, T in enumerate(poses)))
    else:
        (folder / "poses.txt").write_text("".join(matrix_line(T, 3) for T in poses))
    return folder


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("layout", ["tum", "kitti"])
@pytest.mark.parametrize("per_metre", [100, 1000, 4000, 5000, 10000])
def test_the_unit_is_found_whatever_the_layout_usually_has(tmp_path, per_metre, layout, noise):
    source = open_source(recording(tmp_path, per_metre, layout, noise=noise))
    assert source.unit.scale == pytest.approx(1 / per_metre)
    assert source.frame(0).depth_scale == source.unit.scale
    usual = {"tum": 5000, "kitti": 1000}[layout]
    told = [note for note in source.notes if "depth is assumed to be" in note]
    assert len(told) == (per_metre != usual or not source.unit.sure)


def test_an_option_comes_before_what_the_images_show_in_either_notation(tmp_path):
    folder = recording(tmp_path, 1000)
    for text in ("1000", "0.001"):
        assert open_source(f"{folder}?depth_scale={text}").depth_scale == pytest.approx(0.001)
    assert open_source(f"{folder}?depth_scale=2500").depth_scale == pytest.approx(1 / 2500)


def test_a_camera_that_only_turns_shows_no_unit_and_that_is_said(tmp_path):
    poses = [turned(k) for k in range(COUNT)]
    source = open_source(recording(tmp_path, 1000, poses=poses))
    assert source.depth_scale == 1 / 5000  # as the layout has it, which is wrong here
    assert not source.unit.sure
    (note,) = [note for note in source.notes if "depth is assumed to be in 1/5000 m" in note]
    assert "?depth_scale=1000" in note


def test_noise_of_the_poses_does_not_make_a_unit_out_of_nothing(tmp_path):
    rng = np.random.default_rng(3)
    poses = []
    for k in range(COUNT):
        T = turned(0).copy()
        T[:3, 3] += 0.03 * rng.normal(size=3)
        T[:3, :3] = rotation_matrix(0.03 * rng.normal(size=3)) @ T[:3, :3]
        poses.append(T)
        write(tmp_path / f"depth/{k}.0.png", units(render(turned(0)), 1000))
    (tmp_path / "camera-intrinsics.txt").write_text(camera_text())
    (tmp_path / "poses.txt").write_text("".join(matrix_line(T, 3) for T in poses))
    source = open_source(tmp_path)
    assert (source.depth_scale, source.unit.sure) == (0.001, False)


def test_no_pair_keeps_what_is_expected():
    from stereovox.cameras.pinhole import PinholeCamera

    camera = PinholeCamera(64, 48, *K)
    unit = find_unit([], camera, 0.001)
    assert (unit.scale, unit.sure) == (0.001, False)
    assert unit.words == "millimetres"
    assert len({round(1 / scale, 3) for scale in UNITS}) == len(UNITS)


def test_pairs_are_taken_where_the_camera_moved_enough():
    poses = [turned(0) for _ in range(10)] + posed(6)
    pairs = pairs_of(len(poses), lambda i: poses[i], lambda i: np.full((48, 64), i, np.uint16))
    assert pairs
    for first, second in pairs:
        assert np.linalg.norm(first.T_world_camera[:3, 3] - second.T_world_camera[:3, 3]) > 0.03


def recorder(folder, names, raw, camera="camera_intrinsic.json"):
    """Write what Open3D's recorder does (or another): depth/ and the camera, no poses; `raw`: values of the images."""
    for k, name in enumerate(names):
        write_png(folder / f"depth/{name}.png", np.roll(raw, k, axis=1))
    K = [600.0, 0, 0, 0, 600, 0, 319.5, 239.5, 1]
    table = {"width": raw.shape[1], "height": raw.shape[0], "intrinsic_matrix": K}
    (folder / camera).write_text(json.dumps(table))
    return folder


NUMBERED, TIMED = ["000000", "000001", "000002"], [f"1305031102.{k}60407" for k in range(3)]


@pytest.mark.parametrize(
    ("names", "spread", "unit", "sure"),
    [
        (NUMBERED, (700, 5000), 1 / 1000, False),  # a D435 in a room
        (NUMBERED, (300, 900), 1 / 1000, False),  # a D405 above a table
        (NUMBERED, (8000, 24000), 1 / 5000, False),  # 1.6 to 4.8 m; in millimetres a hall of 16 m
        (TIMED, (700, 5000), 1 / 1000, False),  # in TUM's layout, but no room is 0.6 m wide
        (TIMED, (4000, 24000), 1 / 5000, False),
    ],
)
def test_without_poses_the_values_tell_the_unit_and_a_note_names_it(tmp_path, names, spread, unit, sure):
    raw = np.random.default_rng(3).integers(*spread, (480, 640)).astype(np.uint16)
    source = open_images(recorder(tmp_path, names, raw))
    assert (source.depth_scale, source.unit.sure) == (unit, sure)
    (note,) = (note for note in source.notes if note.startswith("depth is assumed to be in"))
    assert f"{tmp_path}?depth_scale=" in note
    fives = open_images(recorder(tmp_path / "kinect", names, raw // 5 * 5))
    if np.median(raw) > 2500:  # millimetres times five: TUM's own
        assert (fives.depth_scale, fives.unit.sure) == (1 / 5000, True)


def test_numbered_images_are_not_one_a_second(tmp_path):
    raw = np.full((480, 640), 1500, np.uint16)
    frames = list(open_images(recorder(tmp_path, NUMBERED, raw)))
    assert [frame.stamp_ns for frame in frames] == [0, 33_333_333, 66_666_666]
    assert any("30 a second" in note for note in open_images(tmp_path).notes)
    assert not any("a second" in note for note in open_images(recorder(tmp_path / "b", TIMED, raw)).notes)
