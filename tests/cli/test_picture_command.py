# SPDX-License-Identifier: Apache-2.0
"""`stereovox picture`: its views, and what it says about wrong use."""

import json

import numpy as np
import pytest

from stereovox import VoxelMap, load_config
from stereovox.cli import main


@pytest.fixture
def saved(tmp_path):
    """A map that knows no camera."""
    cells = np.argwhere(np.ones((6, 4, 5)))
    one = VoxelMap.from_cells(load_config(voxel_size=0.5, up="+z"), cells, np.where(cells[:, 0] == 5, 3.0, -1.5))
    one.save(tmp_path / "map.svox")
    return tmp_path / "map.svox"


CAMERA = ["--eye=0.2,1,1.2", "--toward=3,1,1.2"]


@pytest.mark.parametrize(
    "words", [["layer", "--at", "0.7", *CAMERA], ["axis", *CAMERA], ["space", *CAMERA], ["overview"]]
)
def test_each_view_is_written(saved, tmp_path, capsys, words):
    file = tmp_path / "map.png"
    assert main(["picture", str(saved), str(file), "--json", "--view", *words]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {"picture": str(file)}
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--view", "axis"], "--eye=X,Y,Z --toward=X,Y,Z"),
        (["--view", "axis", "--eye=1,2"], "'1,2' is no point"),
        (["--view", "axis", "--eye=1,2,nan", "--toward=1,2,3"], "'1,2,nan' is no point"),
        (["--view", "axis", "--eye=1,2,3"], "needs both"),
        (["--view", "axes"], "did you mean 'axis'"),
        (["--view", "layer", "--at", "inf"], "layer at inf"),
        (["--view", "layer", "--up", "w"], "up 'w' is no axis"),
        (["--at", "1"], "--at: the view 'overview' does not use it; it goes with: --view layer"),
        (["--view", "space", "--at", "1"], "--at: the view 'space' does not use it"),
        (["--eye=1,2,3"], "--eye: the view 'overview' does not use it; it goes with: --view layer, --view axis, --vi"),
    ],
)
def test_mistakes_are_one_line(saved, tmp_path, capsys, words, said):
    assert main(["picture", str(saved), str(tmp_path / "map.png"), *words]) == 2
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 1
    assert said in err[0]
    assert not (tmp_path / "map.png").exists()


@pytest.mark.parametrize(
    ("up", "at", "said"),
    [("z", "500", "z = 0 to 2.5 m"), ("-y", "0.1", "-y = -2 to 0 m"), ("z", "1", None), ("-y", "-0.3", None)],
)
def test_a_layer_outside_the_map_is_told(saved, tmp_path, capsys, up, at, said):
    assert main(["picture", str(saved), str(tmp_path / "map.png"), "--view", "layer", f"--up={up}", f"--at={at}"]) == 0
    err = capsys.readouterr().err
    assert f"outside the map ({said})" in err if said else "note:" not in err
