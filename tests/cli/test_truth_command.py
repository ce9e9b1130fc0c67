# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import made_kitti as made
import numpy as np
import pytest

from stereovox.cli import main
from stereovox.maps import load_map


def test_it_makes_a_map_and_tells_what_it_did(tmp_path, capsys):
    training = made.tracking(tmp_path)
    out = tmp_path / "truth.svox"
    words = ["truth", str(training), "--out", str(out), "--voxel-size", "0.4", "--max-range", "20", "--json"]
    assert main(words) == 0
    said = capsys.readouterr()
    result = json.loads(said.out.splitlines()[-1])
    voxel_map = load_map(out)
    assert {state: result[state] for state in ("occupied", "free")}.items() <= voxel_map.counts().items()
    assert result["occupied"] > 100
    assert (result["frames"], result["frames_refused"], result["in_boxes"]) == (4, 0, 4 * 9**3)
    dropped = sum(result[key] for key in ("outside_view", "in_boxes", "moving"))
    assert result["points"] == result["used"] + dropped
    assert "in annotated boxes" in said.err
    assert "4 scans used, 0 refused" in said.err


def test_options_reach_the_truth(tmp_path, capsys):
    drive = made.raw(tmp_path)
    out = tmp_path / "truth.svox"
    (drive / "velodyne_points/data/0000000001.bin").unlink()
    words = ["truth", str(drive), "--out", str(out), "--free", "rays", "--frames", ":2", "--voxel-size", "0.4"]
    assert main([*words, "--max-range", "20"]) == 0
    assert "1 x missing_file" in capsys.readouterr().err
    free = load_map(out).free()
    assert len(free) > 0
    assert (free[:, 0] < 15.5).mean() > 0.98  # behind the wall only the way to the one point beyond it
    assert np.isclose(load_map(out).voxel_size, 0.4)


@pytest.mark.parametrize(
    ("source", "says"),
    [("sim:room", "has no lidar scans"), ("nowhere", "no such folder"), ("DRIVE?poses=x.txt", "x.txt: no such file")],
)
def test_a_mistake_is_one_line(tmp_path, capsys, source, says):
    drive = str(made.raw(tmp_path))
    assert main(["truth", source.replace("DRIVE", drive), "--out", str(tmp_path / "t.svox")]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert says in said.err.splitlines()[-1]
    assert not (tmp_path / "t.svox").exists()
