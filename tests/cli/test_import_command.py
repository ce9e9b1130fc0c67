# SPDX-License-Identifier: Apache-2.0
"""`stereovox import`, and `export` of what it takes back."""

import json

import numpy as np
import pytest

import stereovox as sv
from stereovox.cli import main
from stereovox.formats.map_server import read_map_server, write_map_server
from stereovox.maps.occupancy import OccupancyGrid


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sv.VoxelMap.from_cells(sv.load_config(voxel_size=0.5), [[0, 0, 0], [1, 0, 1]], [3.0, -3.0]).save("room.svox")
    write_map_server(OccupancyGrid(np.array([[0, 100, -1]], np.int8), 0.05, (1.0, 2.0, 0.0)), "floor.yaml")
    return tmp_path


def run(capsys, *words):
    status = main([*words, "--json"])
    captured = capsys.readouterr()
    return status, json.loads(captured.out.splitlines()[-1]) if captured.out else captured.err


@pytest.mark.usefixtures("folder")
def test_there_and_back(capsys):
    for file in ("room.ot", "room.npz", "room.pcd", "room.mcap"):
        assert run(capsys, "export", "room.svox", file)[0] == 0
        status, told = run(capsys, "import", file, "again.svox")
        assert (status, told["voxel_size"], told["occupied"]) == (0, 0.5, 1)
        assert told["free"] == (file != "room.pcd")
        assert sv.load_map("again.svox").counts()["occupied"] == 1


@pytest.mark.usefixtures("folder")
def test_a_floor_there_and_back(capsys):
    assert run(capsys, "export", "floor.yaml", "floor.bag")[0] == 0
    status, told = run(capsys, "import", "floor.bag", "again.yaml")
    assert (status, told) == (0, {"map": "again.yaml", "voxel_size": 0.05, "columns": 3, "rows": 1})
    again = read_map_server("again.yaml")
    np.testing.assert_array_equal(again.cells, [[0, 100, -1]])
    assert again.origin == (1.0, 2.0, 0.0)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["import", "none.bt", "m"], "none.bt: cannot be read"),
        (["import", "floor.yaml", "m"], "floor.yaml: is the map of a floor"),
        (["import", "room.ply", "m", "--voxel-size", "0"], "voxel_size"),
        (["import", "room.ply", "room.ply"], "room.ply"),
        (["import", "room.ply", "m", "--topic", "/a"], "--topic does not apply"),
        (["import", "room.ply", "m.yaml"], "room.ply: holds a 3-D map"),
        (["import", "room.bag", "m.yaml", "--voxel-size", "1"], "--voxel-size: a floor map defines"),
        (["import", "room.bag", "m", "--voxel-size", "1"], "room.bag: an Octomap has its own cell size"),
        (["import", "room.svox", "m"], "room.svox"),
        (
            ["export", "room.svox", "m.bag", "--heights", "90:99", "--floor=0"],
            "m.bag: 90 to 99 m above the floor no place",
        ),
        (["export", "room.svox", "room.ply", "--heights", "0:1"], "heights is for 2-D maps"),
        (["export", "floor.yaml", "m.bag", "--heights", "0:1"], "--heights: a floor map is written to a bag unchanged"),
        (["export", "floor.yaml", "m.ply"], "is the map of a floor"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_mistakes_end_in_one_line(folder, capsys, words, said):
    for name in ("room.ply", "room.bag"):
        assert run(capsys, "export", "room.svox", name)[0] == 0
    status, error = run(capsys, *words)
    assert status == 2
    assert said in error.splitlines()[-1], error
    assert "Traceback" not in error
    assert not list(folder.glob("m*"))
    assert (folder / "room.ply").read_bytes().startswith(b"ply")
