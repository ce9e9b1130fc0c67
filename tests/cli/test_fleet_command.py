# SPDX-License-Identifier: Apache-2.0
"""The fleet's command: one line for a newcomer, its plan, and its report on unusable recordings."""

import json

import cv2
import numpy as np
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
    assert "skipped: sim:nowhere: unknown scene" in said.out + said.err
    big = sv.load_map(out)
    assert result["boxes"] == result["boxes_mapped"] == len(big.manifest.boxes) > 0
    assert result["occupied"] == big.counts()["occupied"] > 0
    assert main(["fleet", ONE, "--out", str(out), *WORDS]) == 2
    assert "--resume" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore")
def test_one_thing_is_not_many(tmp_path, capsys):
    """A single frame of a single recording, in a single box."""
    (tmp_path / "scan/depth").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "scan/depth/0.png"), np.full((48, 64), 1000, np.uint16))
    (tmp_path / "scan/camera.toml").write_text("width = 64\nheight = 48\nfx = 60\nfy = 60\ncx = 31.5\ncy = 23.5\n")
    (tmp_path / "scan/poses.txt").write_text("1 0 0 9 0 1 0 9 0 0 1 9\n")
    scan, out = str(tmp_path / "scan?depth_scale=1000"), str(tmp_path / "m.svox")
    words = ["fleet", scan, "--out", out, *WORDS, "--box", "51.2"]
    assert main([*words, "--plan"]) == 0
    assert main(words) == 0
    said = capsys.readouterr().err
    assert "1 frame of 1 recording\n" in said
    assert "at least 1 box of 51.2 m" in said
    assert "1 frame, each in 1.0 of 1 box on average; 1 of these was mapped now" in said


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
