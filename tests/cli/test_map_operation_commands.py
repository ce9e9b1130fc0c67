# SPDX-License-Identifier: Apache-2.0
"""crop, merge, diff, coarsen, frontiers, ground: what they write and say, and how they refuse."""

import numpy as np
import pytest
from made_maps import random_map, table

import stereovox as sv
from stereovox.cli import main
from stereovox.formats.map_server import read_map_server
from stereovox.products.moved import moved

FLOOR = [(x, y, z, 3.0 if z == 0 else -3.0) for x in range(30) for y in range(20) for z in range(14)]


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    """Folders of two random maps and of a floor."""
    folder = tmp_path_factory.mktemp("maps")
    random_map(1).save(folder / "a.svox")
    random_map(2).save(folder / "b.svox")
    cells = np.array(FLOOR)
    sv.VoxelMap.from_cells(sv.load_config(voxel_size=0.1), cells[:, :3].astype(int), cells[:, 3]).save(
        folder / "floor.svox"
    )
    return folder


@pytest.fixture
def refused(capsys):
    def run(*words):
        assert main(list(map(str, words))) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        return err

    return run


def test_merge_of_maps_that_lost_most_of_their_frames_says_so(tmp_path, capsys):
    for seed in (1, 2):
        one = random_map(seed)
        one.history.frames = 2
        one.history.refused["no_pose"] = 5
        one.save(tmp_path / f"{seed}.svox")
    assert main(["merge", str(tmp_path / "1.svox"), str(tmp_path / "2.svox"), "--out", str(tmp_path / "c.svox")]) == 3
    assert "c.svox, but only 4 of 14 frames of both are in the map; look" in capsys.readouterr().err.splitlines()[-1]


def test_crop(maps, tmp_path, told, refused):
    out = tmp_path / "part.svox"
    result = told("crop", maps / "a.svox", out, "--box=-0.5,-inf,0,0.5,inf,1")
    wanted = sv.crop(sv.load_map(maps / "a.svox"), [-0.5, -np.inf, 0], [0.5, np.inf, 1])
    assert table(sv.load_map(out)) == table(wanted)
    assert result["occupied"] == wanted.counts()["occupied"]
    for box, words in {
        "1,2,3": "X0,Y0,Z0",
        "0,0,0,1,x,1": "X0,Y0,Z0",
        "1,0,0,0,1,1": "above",
        "7,7,7,8,8,8": "the map extends",
    }.items():
        assert words in refused("crop", maps / "a.svox", tmp_path / "no.svox", f"--box={box}")
    assert not (tmp_path / "no.svox").exists()
    assert "another name" in refused("crop", out, tmp_path / "." / "part.svox", "--box=0,0,0,1,1,1")
    assert table(sv.load_map(out)) == table(wanted)


def test_coarsen(maps, tmp_path, told, refused):
    told("coarsen", maps / "a.svox", tmp_path / "coarse.svox", "--factor", 2)
    assert table(sv.load_map(tmp_path / "coarse.svox")) == table(sv.coarsen(random_map(1), 2))
    assert "whole number" in refused("coarsen", maps / "a.svox", tmp_path / "no.svox", "--factor", 0)
    assert "another name" in refused("coarsen", maps / "a.svox", maps / "a.svox", "--factor", 2)
    assert "floor's map" in refused("coarsen", maps / "a.svox", tmp_path / "no.yaml", "--factor", 2)
    assert "stereovox info" in refused("map", maps / "a.svox", "--out", tmp_path / "no.svox")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("dear")
    assert "not a stereovox map" in refused("coarsen", maps / "a.svox", tmp_path / "other", "--factor", 2)


def test_merge(maps, tmp_path, told, refused):
    a, b = (maps / name for name in ("a.svox", "b.svox"))
    told("merge", a, b, "--out", tmp_path / "both.svox")
    assert table(sv.load_map(tmp_path / "both.svox")) == table(sv.merge(random_map(1), random_map(2)))
    T = np.array([[0, -1, 0, 0.3], [1, 0, 0, -0.5], [0, 0, 1, 0.2], [0, 0, 0, 1.0]])
    np.savetxt(tmp_path / "T.txt", T)
    wanted = table(sv.merge(random_map(1), random_map(2), T))
    for transform in (tmp_path / "T.txt", "0.3,-0.5,0.2,0,0,0.70710678,0.70710678"):
        told("merge", a, b, "--out", tmp_path / "turned.svox", "--transform", transform)
        assert table(sv.load_map(tmp_path / "turned.svox")) == wanted
    np.savetxt(tmp_path / "bad.txt", 2 * T)
    for transform in (
        "1,2,3",
        "0,0,0,0,0,0,0",
        "nan,0,0,0,0,0,1",
        tmp_path / "none.txt",
        tmp_path / "bad.txt",
        tmp_path,
    ):
        assert "--transform" in refused("merge", a, b, "--out", tmp_path / "no.svox", f"--transform={transform}")
    told("coarsen", b, tmp_path / "coarse.svox", "--factor", 2)
    assert "coarsen" in refused("merge", a, tmp_path / "coarse.svox", "--out", tmp_path / "no.svox")
    same = f"{maps}/../{maps.name}/b.svox"
    for one, out in ((b, b), (b, same), (same, b)):
        assert "another name" in refused("merge", a, one, "--out", out)
    assert "would count twice" in refused("merge", b, same, "--out", tmp_path / "no.svox")


def test_diff(maps, tmp_path, told, refused):
    a, b = (maps / name for name in ("a.svox", "b.svox"))
    out, picture = tmp_path / "d.npz", tmp_path / "d.png"
    result = told("diff", a, b, "--out", out, "--picture", picture)
    changes, saved = sv.difference(random_map(1), random_map(2)), np.load(out)
    for kind in ("appeared", "vanished", "became_known", "became_unknown"):
        assert result[kind] == len(getattr(changes, kind)) > 0
        np.testing.assert_array_equal(saved[kind], getattr(changes, kind))
    assert result["counts"]["free"]["occupied"] == result["appeared"]
    assert picture.stat().st_size > 10_000
    moved(random_map(1), np.diag([-1.0, -1, 1, 1])).save(tmp_path / "turned.svox")
    assert told("diff", a, tmp_path / "turned.svox", "--transform", "0,0,0,0,0,1,0")["became_known"] == 0
    assert ".npz" in refused("diff", a, b, "--out", tmp_path / "d.txt")
    assert ".png" in refused("diff", a, b, "--picture", tmp_path / "d.jpg")


def test_frontiers(maps, tmp_path, told, refused, capsys):
    out, picture = tmp_path / "f.npz", tmp_path / "f.png"
    result = told(
        "frontiers", maps / "floor.svox", "--out", out, "--picture", picture, "--start", "1.5,1,0.8", "--radius", 0.2
    )
    assert sum(one["cells"] for one in result["frontiers"]) == len(np.load(out)["cells"]) > 100
    assert any(one["look_from"] for one in result["frontiers"])
    assert picture.stat().st_size > 10_000
    assert told("frontiers", maps / "floor.svox", "--heights=6:7")["frontiers"] == []
    for option in ("--heights=1", "--start=1,2", "--radius=-1", "--longest=0", "--out=x.txt"):
        assert option.partition("=")[2].split(",")[0] in refused("frontiers", maps / "floor.svox", option)


def test_ground(maps, tmp_path, told, refused):
    found = sv.ground(sv.load_map(maps / "floor.svox"))
    for name in ("ground.npz", "ground.png", "ground.yaml"):
        result = told("ground", maps / "floor.svox", tmp_path / name)
        assert (result["drivable"], result["heights"]) == (600, [0.1, 0.1])
    np.testing.assert_array_equal(np.load(tmp_path / "ground.npz")["footing"], found.footing)
    np.testing.assert_array_equal(read_map_server(tmp_path / "ground.yaml").states, found.grid.states)
    assert (tmp_path / "ground.png").stat().st_size > 10_000
    for name in ("high.npz", "high.png"):
        assert told("ground", maps / "floor.svox", tmp_path / name, "--height", 2)["unknown"] == 600
    for words in (("g.txt",), ("g.npz", "--height=0.05"), ("g.npz", "--start=1"), ("g.npz", "--max-slope=0")):
        refused("ground", maps / "floor.svox", tmp_path / words[0], *words[1:])
