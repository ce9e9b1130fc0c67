# SPDX-License-Identifier: Apache-2.0
"""`stereovox calibrate stereo` and `import` as a user runs them."""

import json

import cv2
import numpy as np
import pytest
from made_boards import BOARD, pinhole_eyes, poses, write_boards

from stereovox.cli import main
from stereovox.sources.rigs.rig_file import read_rig

KITTI = """S_rect_00: 1.242000e+03 3.750000e+02
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 7.2e+02 0 6.1e+02 0 0 7.2e+02 1.7e+02 0 0 0 1 0
P_rect_01: 7.2e+02 0 6.1e+02 -3.6e+02 0 7.2e+02 1.7e+02 0 0 0 1 0
"""


def run(*words):
    return main([str(word) for word in words])


def test_boards_become_a_rig_file_and_a_report(tmp_path, capsys):
    eyes = pinhole_eyes()
    folder = write_boards(tmp_path / "boards", eyes, poses(0.5, 0.16, 4))
    for name in ("left99.png", "right99.png"):
        cv2.imwrite(str(folder / name), np.full((240, 320), 90, np.uint8))
    cv2.imwrite(str(folder / "left77.png"), np.full((240, 320), 90, np.uint8))
    out, report = tmp_path / "rig.toml", tmp_path / "report"
    words = ["--board", f"{BOARD.columns}x{BOARD.rows}", "--square", BOARD.square, "--out", out, "--name", "front"]
    assert run("calibrate", "stereo", folder, *words, "--report", report, "--json") == 0
    streams = capsys.readouterr()
    told = json.loads(streams.out.splitlines()[-1])
    assert told["used"] == 4
    assert told["out"] == str(out)
    assert "99: skipped, no board of 7x5 inner corners in left99.png and right99.png" in streams.err
    assert "rows after rectification" in streams.err
    assert "note: no image of the other eye for left77.png\n" in streams.err
    assert told["unmatched"] == ["left77.png"]
    assert "millimetres" not in streams.err
    (pair,) = read_rig(out).pairs
    assert pair.name == "front"
    assert pair.eyes.baseline == pytest.approx(eyes.baseline, rel=0.03)
    assert pair.eyes.baseline == pytest.approx(told["baseline_m"])
    assert pair.stereo_pair().camera.width == 320
    assert (report / "stereo.png").read_bytes().startswith(b"\x89PNG")
    page = (report / "stereo.html").read_text()
    assert f"{told['rms_px']:.3f}" in page
    assert "left99.png" in page


def test_a_calibration_is_imported(tmp_path, capsys):
    (tmp_path / "calib.txt").write_text(KITTI)
    assert run("calibrate", "import", tmp_path / "calib.txt", "--out", tmp_path / "rig.toml", "--json") == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["pairs"] == [{"name": "grey", "baseline_m": 0.5, "rectified": True}]
    assert read_rig(tmp_path / "rig.toml").pairs[0].camera.height == 375


def test_millimetres_are_suspected(tmp_path, capsys):
    folder = write_boards(tmp_path / "boards", pinhole_eyes(), poses(0.5, 0.16, 3))
    words = ["--board", f"{BOARD.columns}x{BOARD.rows}", "--square", 1000 * BOARD.square, "--out", tmp_path / "r.toml"]
    assert run("calibrate", "stereo", folder, *words) == 0
    assert "is --square 40 in millimetres?" in capsys.readouterr().err
    for apart, suspected in ((-3.6e2, False), (-3.6e5, True)):
        (tmp_path / "calib.txt").write_text(KITTI.replace("-3.6e+02", str(apart)))
        assert run("calibrate", "import", tmp_path / "calib.txt", "--out", tmp_path / "rig.toml") == 0
        assert ("millimetres?" in capsys.readouterr().err) is suspected


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["stereo", "no", "--board", "9", "--square", "0.1", "--out", "r.toml"], "--board 9: write inner corners"),
        (["stereo", "no", "--board", "9x6", "--square", "0", "--out", "r.toml"], "square"),
        (["stereo", "no", "--board", "9x6", "--square", "0.1", "--out", "r.txt"], "ends in .toml"),
        (["stereo", "no", "--board", "9x6", "--square", "0.1", "--out", "r.toml"], "no such folder"),
        (["stereo", "no", "--board", "9x6", "--square", "1", "--out", "r.toml", "--lens", "omni"], "--lens omni"),
        (["import", "no.yaml", "--out", "r.toml"], "no.yaml: No such file"),
        (["import", "no.yaml", "--out", "r.toml", "--size", "12"], "--size 12"),
    ],
)
def test_mistakes_are_one_line(tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    assert run("calibrate", *words) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]
    assert not (tmp_path / "r.toml").exists()
