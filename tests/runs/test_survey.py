# SPDX-License-Identifier: Apache-2.0
"""The findings of a quick survey of a recording, and what it does not claim to know."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_depth import K, camera_text, matrix_line, posed, render, units, write

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.geometry.se3 import rotation_matrix
from stereovox.opening import open_source
from stereovox.runs.survey import suggest_cell, suggest_range, survey

DATA = Path(__file__).resolve().parents[2] / "../shared/data"
KITCHENS = ("sevenscenes_redkitchen", "sevenscenes_30hz")
KITCHEN_UP = (0.008, -0.889, -0.457)
"""Gravity of the scene, from its floor and tables; 27 degrees off -y."""


def recording(folder, R_world=None, poses=None):
    """The made room in a world that is turned by R_world (3, 3)."""
    poses = posed(8) if poses is None else poses
    for k, T in enumerate(poses):
        write(folder / f"depth/{k}.png", units(render(T), 1000))
    T_world = np.eye(4)
    T_world[:3, :3] = np.eye(3) if R_world is None else R_world
    (folder / "camera-intrinsics.txt").write_text(camera_text())
    (folder / "poses.txt").write_text("".join(matrix_line(T_world @ T, 3) for T in poses))
    return open_source(folder)


def degrees(a, b):
    return np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1)))


def looking(forward, up, count=6):
    """Poses of a camera that faces along `forward`, moving sideways."""
    forward, up = np.asarray(forward, float), np.asarray(up, float)
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(forward, up), -up, forward], axis=1)
    found = []
    for k in range(count):
        T = T.copy()
        T[:3, 3] = 1.0 + 0.15 * k, 1.4, 1.3
        found.append(T)
    return found


@pytest.mark.parametrize("name", KITCHENS)
def test_up_of_a_handheld_recording_is_found_between_the_axes(name):
    if not (DATA / name).is_dir():
        pytest.skip(f"{name} is not here")
    found = survey(open_source(DATA / name))
    assert found.up.sure
    assert found.up.axis == "-y"
    assert degrees(found.up.direction, KITCHEN_UP) < 5
    settings, (line,) = found.settings({})
    assert settings["up"] == "-y"
    assert degrees(settings["up_direction"], KITCHEN_UP) < 5
    assert "27 degrees" in line
    assert "--set up=" in line


@pytest.mark.parametrize("seed", range(8))
def test_up_is_found_in_any_world(tmp_path, seed):
    rng = np.random.default_rng(seed)
    R = rotation_matrix(rng.normal(size=3) * 2)
    found = survey(recording(tmp_path, R))
    assert degrees(found.up.direction, R[:, 2]) < 5
    settings, lines = found.settings({})
    if found.up.sure:  # else no axis is near enough
        axis = np.zeros(3)
        axis["xyz".index(found.up.axis[-1])] = -1 if found.up.axis.startswith("-") else 1
        assert degrees(axis, R[:, 2]) < 45
        assert settings["up"] == found.up.axis or (found.up.axis == "z" and "up" not in settings)
    else:
        assert "up" not in settings
        assert "uncertain" in lines[0]


def test_a_camera_that_looks_straight_down_does_not_take_its_way_for_up(tmp_path):
    source = recording(tmp_path, poses=looking((0, 0, -1), (1, 0, 0)))
    found = survey(source)
    settings, lines = found.settings({})
    assert not found.up.sure
    assert "up" not in settings
    assert any("the up direction is uncertain" in line for line in lines)


def test_a_camera_held_on_its_side_does_not_take_walls_for_floors(tmp_path):
    aside = np.eye(4)
    aside[:3, :3] = rotation_matrix([0, 0, np.pi / 2])  # about the optical axis
    found = survey(recording(tmp_path, poses=[T @ aside for T in posed(8)]))
    assert degrees(found.up.direction, (0, 0, 1)) > 80
    assert not found.up.sure


def test_a_sensor_that_hangs_upside_down_does_not_turn_the_map_over(tmp_path):
    over = np.diag([-1.0, -1, 1, 1])  # about the optical axis
    found = survey(recording(tmp_path, poses=[T @ over for T in posed(8)]))
    settings, lines = found.settings({})
    assert "up" not in settings  # so that z, the world's, stays
    assert any(
        "perhaps -z (the sensor hangs upside down, or the world's z points down); z is" in line for line in lines
    )


def test_a_camera_that_was_turned_over_says_nothing_about_up(tmp_path):
    upright, over = looking((1, 0, 0), (0, 0, 1)), looking((1, 0, 0), (0, 0, -1))
    found = survey(recording(tmp_path, poses=[*upright, *over]))
    assert not found.up.sure


def test_what_the_user_chose_is_kept(tmp_path):
    found = survey(recording(tmp_path, rotation_matrix([np.pi / 2, 0, 0])))
    assert found.settings({})[0]["up"] in ("y", "-y")
    settings, lines = found.settings({"up": "x", "voxel_size": 0.1, "max_range": 3.0})
    assert (settings, lines) == ({}, [])


def test_simulations_and_streets_know_which_way_is_up():
    found = survey(open_source("sim:room?image_width=160", frames="::40"))
    assert (found.up.axis, found.up.sure) == ("z", True)
    assert found.settings({}) == ({}, [])
    assert found.frames == 6
    assert found.rate_hz == pytest.approx(0.75, rel=0.01)


CAMERA = PinholeCamera(640, 480, 525, 525, 320, 240, 0.075)


@pytest.mark.parametrize(
    ("depths", "baseline", "stereo", "expected"),
    [
        (np.full(100, 2.0), 0.075, False, 5.0),
        (np.linspace(1, 12, 100), None, False, 15.0),  # no baseline: exact depth
        (np.linspace(1, 12, 100), 0.075, False, 5.0),  # a Kinect is good to 3.9 m
        (np.empty(0), 0.54, True, 30.0),
        (np.empty(0), 0.05, True, 5.0),
    ],
)
def test_the_range_is_what_the_depths_need_and_the_baseline_allows(depths, baseline, stereo, expected):
    camera = PinholeCamera(640, 480, 525, 525, 320, 240, baseline)
    assert suggest_range(depths, camera, stereo).value == expected


def test_cells_grow_with_the_range_and_shrink_with_a_near_scene():
    assert suggest_cell(np.full(9, 2.0), 5.0).value == 0.05
    assert suggest_cell(np.empty(0), 40.0).value == 0.2
    assert suggest_cell(np.full(9, 0.6), 5.0).value == 0.005
    assert suggest_cell(np.full(9, 0.01), 5.0).value == 0.002


def test_a_recording_without_poses_has_no_up(tmp_path):
    for k in range(3):
        write(tmp_path / f"depth/{k}.png", units(render(posed(3)[k]), 1000))
    (tmp_path / "camera-intrinsics.txt").write_text(camera_text(K))
    (tmp_path / "poses.txt").write_text("nan " * 12 + "\n" + "nan " * 12 + "\n" + "nan " * 12)
    found = survey(open_source(tmp_path))
    assert (found.posed, found.up, found.extent_m) == (0, None, None)
    assert found.depth_m is not None
