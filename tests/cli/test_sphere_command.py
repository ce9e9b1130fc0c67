# SPDX-License-Identifier: Apache-2.0
"""`stereovox sphere`: what is near, in words, in JSON and as a picture."""

import json

import numpy as np
import pytest

from stereovox.cli import main
from stereovox.depth.sphere import MAIN_DIRECTIONS, SphereLayout
from stereovox.simulate.surround import Surround
from stereovox_lab.checks.surround import nearest_surfaces

DRONE = "sim:surround?scale=0.4&moments=5"


def run(capsys, *words):
    status = main(["sphere", *map(str, words)])
    return status, capsys.readouterr()


def test_tells_what_is_near_and_draws_it(tmp_path, capsys):
    file = tmp_path / "sphere.png"
    words = (DRONE, "--frames", "8:12", "--out", file, "--step", "5", "--json", "--max-range", "12")
    status, said = run(capsys, *words)
    assert status == 0
    assert file.read_bytes().startswith(b"\x89PNG")
    result = json.loads(said.out.splitlines()[-1])
    assert result["picture"] == str(file)
    assert result["step_deg"] == 5
    assert list(result["directions"]) == list(MAIN_DIRECTIONS)
    drone, layout = Surround(DRONE), SphereLayout.of(5)
    nearest, _ = nearest_surfaces(drone.scene, drone.body_pose(8), layout)
    for name in ("left", "right", "down"):
        axis = np.array(MAIN_DIRECTIONS[name])
        truth = nearest[np.arccos(np.clip(layout.directions() @ axis, -1, 1)) < np.radians(45)].min()
        sight = result["directions"][name]
        assert sight["range_m"] == pytest.approx(truth, rel=0.25), name
        assert sight["surface"]
        assert (sight["age_s"], sight["seen"] > 0.8) == (0, True)
    line = next(line for line in said.err.splitlines() if line.strip().startswith("left:"))
    assert f"{result['directions']['left']['range_m']:.2f} m" in line
    assert "0.00 s ago" in line


def test_a_depth_camera_looks_ahead(capsys):
    status, said = run(capsys, "sim:wall?distance=2&image_width=212", "--frames", ":2", "--json", "--step", "5")
    assert status == 0
    sights = json.loads(said.out.splitlines()[-1])["directions"]
    assert sights["front"]["range_m"] == pytest.approx(2, abs=0.15)
    assert sights["back"] is None
    assert "back: unknown" in said.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((DRONE, "--step", "7"), "step_deg must divide 180"),
        ((DRONE, "--out", "sphere.jpg"), "--out sphere.jpg: end the file's name with .png"),
        (("sim:surround?pair=up",), "pair=up is unknown"),
        (("nowhere",), "no such folder"),
    ],
)
def test_mistakes_are_one_line(capsys, words, message):
    status, said = run(capsys, *words)
    assert status == 2
    assert message in said.err
    assert len(said.err.strip().splitlines()) == 1
