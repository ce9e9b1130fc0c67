# SPDX-License-Identifier: Apache-2.0
"""What `stereovox info` says: no digits that mean nothing, nothing twice, and commands that can work."""

import json

import numpy as np
import pytest
from made_depth import camera_text, matrix_line, posed, render, units, write

import stereovox as sv
from stereovox.cli import main
from stereovox.descriptions.files import many, metres
from stereovox.runs.survey import UpEstimate


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ([1.71, 0.55, 0.934], "1.7 x 0.6 x 0.9 m"),
        ([0.003, 0.0982, 0.0061], "3 x 98 x 6 mm"),
        ([564.3, 26.0, 496], "564 x 26 x 496 m"),
    ],
)
def test_lengths_have_few_digits(numbers, text):
    assert metres(np.array(numbers)) == text


def test_one_thing_is_no_plural():
    assert [many(n, "pose") for n in (0, 1, 4541)] == ["0 poses", "1 pose", "4,541 poses"]


@pytest.mark.parametrize(("off_deg", "words"), [(1.0, "up is -y"), (27.4, "up is 27 degrees from -y")])
def test_up_in_words(off_deg, words):
    assert UpEstimate("-y", np.array([0, -1.0, 0]), np.radians(off_deg), True, "").words == words


def test_a_recording_names_map_then_picture():
    found = sv.describe("sim:room?image_width=160")
    assert found.commands == [
        "stereovox map 'sim:room?image_width=160' --out room.svox",
        "stereovox picture room.svox room.png",
    ]
    assert len(set(found.lines)) == len(found.lines)


def test_a_kalibr_chain_is_no_floor_map(tmp_path):
    """Both have a resolution."""
    camera = "  intrinsics: [460.0, 460.0, 370.0, 240.0]\n  distortion_coeffs: [0, 0, 0, 0]\n"
    camera += "  camera_model: pinhole\n  distortion_model: radtan\n  resolution: [752, 480]\n"
    chain = tmp_path / "camchain.yaml"
    move = "  T_cn_cnm1: [[1, 0, 0, -0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    chain.write_text(f"%YAML:1.0\ncam0:\n{camera}cam1:\n{camera}{move}")
    found = sv.describe(chain)
    assert found.kind == "calibration"
    assert found.commands[0].startswith("stereovox calibrate import ")


def test_describe_stays_a_function():
    """A module of that name would take its place once it is imported."""
    for _ in range(2):
        assert sv.describe("sim:floor").kind == "robot"


def test_facts_are_plain_numbers():
    """A NumPy bool in them ended `info --json` in a traceback."""
    found = sv.describe("sim:box?image_width=160")
    assert json.loads(json.dumps(found.facts))["up_sure"] is True


def test_a_file_of_no_kind_is_not_sent_in_a_circle(tmp_path, capsys):
    (tmp_path / "notes.xyzzy").write_text("nothing here can read this")
    assert main(["info", str(tmp_path / "notes.xyzzy")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "is of no known kind" in line
    assert "stereovox info" not in line


@pytest.mark.parametrize("command", ["info", "map", "picture"])
def test_a_link_to_itself_is_one_line(tmp_path, capsys, command):
    (tmp_path / "loop").symlink_to("loop")
    assert main([command, f"{tmp_path / 'loop'}?fps=5"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "loop" in line


def test_what_a_quick_look_found_goes_into_json(tmp_path, capsys):
    folder = tmp_path / "walk"
    for k, T in enumerate(posed()):
        write(folder / f"depth/{k}.png", units(render(T), 1000))
    (folder / "camera-intrinsics.txt").write_text(camera_text())
    (folder / "poses.txt").write_text("".join(map(matrix_line, posed())))
    assert main(["info", str(folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["unit"], found["unit_sure"], found["up"], found["up_sure"]) == ("millimetres", True, "z", True)
