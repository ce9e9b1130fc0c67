# SPDX-License-Identifier: Apache-2.0
import json
import runpy
import sys
from itertools import pairwise
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from stereovox.cli import main
from stereovox.config import load_config
from stereovox.maps import State, VoxelMap, load_map
from stereovox.view.path import draw_path

EXAMPLE = Path(__file__).resolve().parents[2] / "examples/plan_path.py"
SHAPE = 30, 20, 12


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A room of 3 x 2 x 1.2 m in cells of 0.1 m, free inside, with a wall at 1.5 m; its door is at the low y."""
    cells = np.indices(SHAPE).reshape(3, -1).T
    outside = ((cells == 0) | (cells == np.array(SHAPE) - 1)).any(axis=1)
    wall = (cells[:, 0] == 15) & (cells[:, 1] > 9)
    config = load_config(voxel_size=0.1, **{"map.keep_times": True})
    voxel_map = VoxelMap.from_cells(config, cells, np.where(outside | wall, 2.0, -3.0))
    coords, blocks = voxel_map.storage.blocks()
    voxel_map.storage.set_times(coords, np.full(blocks.shape, 2**30 + 100, np.uint32), 0)
    path = tmp_path_factory.mktemp("maps") / "room.svox"
    voxel_map.save(path)
    return str(path)


def told(capsys, *words):
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_distances_are_written_as_scipy_measures_them(saved, tmp_path, capsys):
    file, picture = str(tmp_path / "d.npz"), str(tmp_path / "d.png")
    result = told(capsys, "distance", saved, file, "--picture", picture, "--at", "0.65", "--max", "0.35")
    assert (result["shape"], result["obstacles"]) == (list(SHAPE), 7200 - 28 * 18 * 10 + 9 * 10)
    arrays = np.load(file)
    voxel_map = load_map(saved)
    middles = arrays["origin"] + (np.indices(SHAPE).reshape(3, -1).T + 0.5) * arrays["cell"]
    occupied = (voxel_map.state(middles) == State.OCCUPIED).reshape(SHAPE)
    away = distance_transform_edt(~occupied, sampling=0.1)
    assert away.max() > 0.35
    np.testing.assert_allclose(arrays["distance"], np.where(away > 0.351, np.inf, away), rtol=1e-6)
    assert matplotlib.image.imread(picture).std() > 0.05
    unknown = told(capsys, "distance", saved, file, "--to", "unknown", "--box=-1,-1,0,3.5,3,1")
    assert (unknown["shape"], unknown["origin"]) == ([45, 40, 10], [-1, -1, 0])
    assert np.load(file)["distance"].max() < 1


def test_paths_are_checked(saved, tmp_path, capsys):
    picture = str(tmp_path / "p.png")
    round_the_wall = ["0.5,1.5,0.6", "0.5,0.5,0.6", "2.5,0.5,0.6", "2.5,1.5,0.6"]
    free = told(capsys, "path", saved, *round_the_wall, "--radius", "0.3", "--picture", picture)
    assert (free["free"], free["blocked_at_m"], free["segments"]) == (True, None, ["free"] * 3)
    assert free["length_m"] == pytest.approx(4)
    assert free["oldest_s"] == [pytest.approx(-1.0)] * 3, "seen 1 s after the stamp at which the map stands"
    assert matplotlib.image.imread(picture).std() > 0.05
    through = told(capsys, "path", saved, "0.5,1.5,0.6", "2.5,1.5,0.6", "--radius", "0.3")
    assert not through["free"]
    assert through["blocked_at"] == pytest.approx([1.2, 1.5, 0.6])
    line = np.array([[0.5, 1.5, 0.6], [2.5, 1.5, 0.6]])
    above = [draw_path(load_map(saved), line, radius, "", at).axes[0] for radius, at in ((0.0, None), (1e-12, 0.7))]
    assert len(above[1].lines) == len(above[0].lines) + 1, "the cross where it is blocked"
    outside = told(capsys, "path", saved, "-2,0,0", "-1,0,0", "--radius", "0.3")
    assert outside["segments"] == ["unknown"]
    assert told(capsys, "path", saved, "-2,0,0", "-1,0,0", "--radius", "0.3", "--through-unknown")["free"]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["distance", "MAP", "d.txt"], "FILE d.txt: end the file's name with .npz"),
        (["distance", "MAP", "d.npz", "--box", "1,2,3"], "--box 1,2,3: write X0,Y0,Z0,X1,Y1,Z1"),
        (["distance", "MAP", "d.npz", "--box", "3,3,3,1,1,1"], "lower one first"),
        (["distance", "MAP", "d.npz", "--max", "-1"], "more than 0 m"),
        (["distance", "MAP", "d.npz", "--measure", "feet"], "centres, faces, gap"),
        (["distance", "MAP", "d.npz", "--at", "1"], "--picture"),
        (["distance", "MAP", "d.npz", "--picture", "d.png", "--at", "9"], "outside the box"),
        (["path", "MAP", "1,1,1", "--radius", "0.3"], "two or more"),
        (["path", "MAP", "1,1,1", "2,2,2", "--radius", "0.3", "--picture", "p.jpg"], "--picture p.jpg: end the file's"),
        (["path", "MAP", "1,1", "2,2,2", "--radius", "0.3"], "'1,1' is not a point"),
        (["path", "MAP", "1,1,1", "2,2,2", "--radius", "-1"], "0 m or more"),
        (["path", "MAP", "1,1,1", "2,2,2"], "--radius"),
        (["path", "no.svox", "1,1,1", "2,2,2", "--radius", "1"], "no.svox"),
    ],
)
def test_mistakes_end_in_one_line(words, complaint, saved, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([saved if word == "MAP" else word for word in words]) == 2
    error = capsys.readouterr().err
    assert complaint in error
    assert error.count("\n") <= 4


def test_the_planner_keeps_its_distance(saved, tmp_path, monkeypatch, capsys):
    """Every point of the path is farther than the radius from the nearest face of any cell that is not free."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), saved, "0.55,0.55,0.65", "2.45,0.55,0.65"])
    plan = runpy.run_path(str(EXAMPLE), run_name="__main__")["plan"]
    assert "saved plan.png" in capsys.readouterr().out
    assert matplotlib.image.imread("plan.png").std() > 0.05
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), saved, "0.55,0.55,0.65"])
    with pytest.raises(SystemExit, match="MAP START GOAL"):
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    voxel_map, start, goal = load_map(saved), np.array([0.55, 1.45, 0.65]), np.array([2.45, 1.45, 0.65])
    way = plan(voxel_map, start, goal, 0.25)
    np.testing.assert_array_equal(way[[0, -1]], [start, goal])
    cells = np.indices(np.array(SHAPE) + 8).reshape(3, -1).T - 4
    blocked = cells[voxel_map.state((cells + 0.5) * 0.1) != State.FREE]
    for a, b in pairwise(way):
        for share in np.linspace(0, 1, 5):
            place = a + share * (b - a)
            away = np.linalg.norm(place - np.clip(place, blocked * 0.1, (blocked + 1) * 0.1), axis=1).min()
            assert away >= 0.25 - 1e-9
    length = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    assert 2.5 < length < 3.2, "round the wall, and not much farther than it has to"
    assert plan(voxel_map, start, goal, 0.5) is None
    assert plan(voxel_map, start, np.array([2.45, 1.45, 3.0]), 0.25) is None
    assert plan(voxel_map, np.array([-0.9, 0.5, 0.5]), np.array([-0.9, 1.5, 0.5]), 0.25) is None
    assert (
        plan(voxel_map, np.array([-0.9, 0.5, 0.5]), np.array([-0.9, 1.5, 0.5]), 0.25, through_unknown=True) is not None
    )
