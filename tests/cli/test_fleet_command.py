# SPDX-License-Identifier: Apache-2.0
"""The fleet's command: one line for a newcomer, its plan, and what it says of recordings that cannot be used."""

import json

import pytest

import stereovox as sv
from stereovox.cli import main

pytest.importorskip("distributed")
ONE = "sim:box?image_width=64"
WORDS = ["--profile", "default", "--voxel-size", "0.2", "--box", "6.4", "--workers", "1"]


@pytest.mark.filterwarnings("ignore")
def test_two_recordings_one_line(tmp_path, capsys):
    out = tmp_path / "town.svox"
    recordings = [ONE, "sim:nowhere"]
    assert main(["fleet", *recordings, "--out", str(out), *WORDS, "--json"]) == 3  # one is left out
    said = capsys.readouterr()
    result = json.loads(said.out.splitlines()[-1])
    assert "left out: sim:nowhere: unknown scene" in said.out + said.err
    big = sv.load_map(out)
    assert result["boxes"] == result["boxes_mapped"] == len(big.manifest.boxes) > 0
    assert result["occupied"] == big.counts()["occupied"] > 0
    assert main(["fleet", ONE, "--out", str(out), *WORDS]) == 2
    assert "--resume" in capsys.readouterr().err


def test_a_plan_writes_nothing(tmp_path, capsys):
    out = tmp_path / "town.svox"
    assert main(["fleet", ONE, "--out", str(out), *WORDS, "--plan", "--json"]) == 0
    said = capsys.readouterr()
    plan = json.loads(said.out.splitlines()[-1])
    assert plan["frames"] == len(sv.open_source(ONE))
    assert plan["overlap"] >= 1
    assert plan["boxes"] >= 1
    assert plan["bytes"] > 0
    assert plan["core_hours"] > 0
    assert " s of a core like one of this machine" in said.out + said.err
    assert not out.exists()
