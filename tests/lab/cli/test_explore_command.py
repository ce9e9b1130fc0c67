# SPDX-License-Identifier: Apache-2.0
"""explore: what it writes and says, and how it refuses."""

import json

import pytest

from stereovox.cli import main
from stereovox.maps import load_map


def test_explore_writes_a_report_and_a_map(told_with_notes, tmp_path):
    out = tmp_path / "missions"
    words = ["explore", "sim:hall?plan={seed}", "--seeds", "2:3", "--seconds", 2, "--voxel-size", 0.2, "--out", out]
    result, said = told_with_notes(*words)
    assert "least clearance" in said
    assert [flight["seed"] for flight in result["flights"]] == [2]
    assert result["scenes"][0]["collisions"] == 0
    written = json.loads((out / "explore.json").read_text())
    assert written["flights"] == result["flights"]
    assert "sim:hall?plan={seed}" in (out / "explore.html").read_text()
    assert load_map(result["maps"][0]).config.voxel_size == 0.2


def test_explore_says_how_to_have_a_page(told_with_notes):
    said = told_with_notes("explore", "sim:hall?plan=2", "--seeds", "2:3", "--seconds", 1, "--voxel-size", 0.2)[1]
    assert said.splitlines()[-1].startswith("nothing is written; --out DIR writes a page")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--seeds", "3"], "--seeds 3: give the first seed"),
        (["--seeds", "3:3"], "--seeds 3:3"),
        (["--speed", "0"], "speed 0.0"),
        (["--jobs", "0"], "jobs 0"),
        (["recordings/kitchen"], "recordings/kitchen: missions are flown in simulations"),
        (["--mission", "land"], "land"),
    ],
)
def test_mistakes_end_in_one_line(words, complaint, capsys):
    assert main(["explore", *words]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("compiling")]
    assert len(lines) == 1
    assert complaint in lines[0]
