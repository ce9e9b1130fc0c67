# SPDX-License-Identifier: Apache-2.0
"""What a run takes from a survey of the recording, and levelled maps."""

from __future__ import annotations

from argparse import Namespace

import numpy as np
import pytest
from made_depth import camera_text, matrix_line, posed, render, units, write

import stereovox as sv
from stereovox.cli.look.view import _recording
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import rotation_matrix
from stereovox.opening import open_source
from stereovox.products.blocks import check_alike
from stereovox.products.moved import level_transform, levelled, moved
from stereovox.products.projection import LiveProjection, project

TILT = rotation_matrix([0.4, 0.15, 0.0]) @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""The made room, whose z is up, in a world whose -y is nearly up."""
SETTINGS = {"map.prior": 0.3, "trust.max_disagreement": 1.0}


@pytest.fixture
def recording(tmp_path):
    folder = tmp_path / "scan"
    T_world = np.eye(4)
    T_world[:3, :3] = TILT
    for k, T in enumerate(posed(8)):
        write(folder / f"depth/{k}.png", units(render(T), 1000))
    (folder / "camera-intrinsics.txt").write_text(camera_text())
    (folder / "poses.txt").write_text("".join(matrix_line(T_world @ T, 3) for T in posed(8)))
    return folder


def degrees(a, b):
    return np.degrees(np.arccos(np.clip(np.dot(a, b), -1, 1)))


def run(recording, out, **options):
    lines = []
    result = sv.map_recording(recording, out, notify=lines.append, **SETTINGS, **options)
    return result.map, lines


def fullest_layer(voxel_map, axis):
    """Number of occupied cells in the layer across an axis that has most."""
    layers = np.floor(voxel_map.occupied()[:, axis] / voxel_map.voxel_size).astype(int)
    return int(np.bincount(layers - layers.min()).max())


def test_up_is_told_and_kept_with_the_map(recording, tmp_path):
    made, lines = run(recording, tmp_path / "m.svox")
    (line,) = [line for line in lines if "up is" in line]
    assert "with --level the map is too" in line
    assert "--set up=" in line
    _, lines = run(recording, tmp_path / "l.svox", level=True)
    assert ["the map is turned upright" in line for line in lines if "up is" in line] == [True]
    again = sv.load_map(tmp_path / "m.svox").config
    assert again.up == {True: "-y", False: "y"}[TILT[1, 2] < 0]
    assert degrees(again.up_direction, TILT[:, 2]) < 5
    assert made.config.tilt == pytest.approx(np.arccos(abs(TILT[1, 2])), abs=0.1)


def test_what_the_user_says_comes_first(recording, tmp_path):
    made, lines = run(recording, tmp_path / "m.svox", up="x", voxel_size=0.1)
    assert (made.config.up, made.config.up_direction, made.voxel_size) == ("x", None, 0.1)
    assert not [line for line in lines if "up is" in line]
    made, lines = run(recording, tmp_path / "n.svox", profile="default")
    assert (made.config.up, lines) == ("z", [line for line in lines if "up is" not in line])


def test_a_tilted_map_is_no_floor_and_a_levelled_picture_is(recording, tmp_path):
    made, _ = run(recording, tmp_path / "m.svox")
    with pytest.raises(StereovoxError, match="--level"):
        project(made)
    with pytest.raises(StereovoxError, match="--level"):
        LiveProjection(made)
    level = levelled(made)
    assert (level.config.up, level.config.up_direction) == ("z", None)
    assert project(level, (0.1, 18.0), floor=-9.0).cells.size
    assert levelled(level) is level


def test_a_level_map_has_its_floor_in_one_layer(recording, tmp_path):
    tilted, _ = run(recording, tmp_path / "m.svox")
    level, _ = run(recording, tmp_path / "l.svox", level=True)
    assert (level.config.up, level.config.up_direction) == ("z", None)
    assert degrees(level.config.levelled_from, TILT[:, 2]) < 5
    assert fullest_layer(level, 2) > 1.5 * fullest_layer(tilted, 1)
    assert project(level, (0.1, 18.0), floor=-9.0).cells.size


def test_a_level_map_is_resumed_in_its_own_world(recording, tmp_path):
    whole, _ = run(recording, tmp_path / "whole.svox", level=True)
    run(recording, tmp_path / "m.svox", level=True, frames=":4")
    resumed, _ = run(recording, tmp_path / "m.svox", resume=True)  # `level` need not be said again
    assert resumed.frames == whole.frames == 8
    assert degrees(resumed.config.levelled_from, TILT[:, 2]) < 8
    assert np.abs(resumed.path - whole.path).max() < 0.1  # one world for all, found from the first four


def test_a_profile_that_says_which_way_is_up_counts_for_level(recording, tmp_path):
    (tmp_path / "mine.toml").write_text('up = "-y"\n[map]\nprior = 0.3\n')
    made = sv.map_recording(recording, tmp_path / "m.svox", profile=tmp_path / "mine.toml", level=True).map
    assert made.config.levelled_from == (0, -1, 0)
    assert made.config.up == "z"


def test_a_level_map_that_is_moved_is_in_another_world(recording, tmp_path):
    level, _ = run(recording, tmp_path / "l.svox", level=True)
    there = moved(level, np.eye(4))
    assert level.config.levelled_from is not None
    assert there.config.levelled_from is None


def test_level_needs_to_know_which_way_is_up(recording, tmp_path):
    lines = [" ".join(["nan"] * 12)] * 2 + (recording / "poses.txt").read_text().splitlines()[:1] * 6
    (recording / "poses.txt").write_text("\n".join(lines))
    for k in range(8):  # nothing but a wall before a camera that does not move
        write(recording / f"depth/{k}.png", np.full((48, 64), 1500, np.uint16))
    with pytest.raises(StereovoxError, match="--set up="):
        run(recording, tmp_path / "m.svox", level=True)
    made, _ = run(recording, tmp_path / "m.svox", level=True, up="-y")
    assert made.config.levelled_from == (0, -1, 0)


def test_a_map_that_is_not_level_is_not_resumed_with_level(recording, tmp_path):
    run(recording, tmp_path / "m.svox", frames=":4")
    with pytest.raises(StereovoxError, match="begun without"):
        run(recording, tmp_path / "m.svox", level=True, resume=True)


def test_level_takes_the_direction_that_the_user_gives(recording, tmp_path):
    made, _ = run(recording, tmp_path / "m.svox", level=True, up="-y", up_direction=(0.0, -0.8, 0.6))
    assert made.config.levelled_from == (0.0, -0.8, 0.6)
    with pytest.raises(StereovoxError, match="up_direction"):
        run(recording, tmp_path / "n.svox", level=True, up="-y", up_direction="up")


def test_a_levelled_map_is_replayed_in_its_own_world_and_not_merged_with_another(recording, tmp_path):
    level, _ = run(recording, tmp_path / "l.svox", level=True)
    tilted, _ = run(recording, tmp_path / "m.svox", up="z")
    arguments = Namespace(recording=str(recording), frames=None)
    source = _recording(arguments, level.config)
    T = level_transform(level.config.levelled_from)
    np.testing.assert_allclose(source.frame(3).T_world_sensor, T @ open_source(recording).frame(3).T_world_sensor)
    assert len(source) == len(open_source(recording))
    with pytest.raises(StereovoxError, match="levelled differently"):
        check_alike(level, tilted, None)
    check_alike(level, tilted, T)
