# SPDX-License-Identifier: Apache-2.0
"""`stereovox calibrate wall` and `noise` as a user runs them, from recordings to a map that is better for it."""

import json
import os

import numpy as np
import pytest
from made_recordings import write_png

import stereovox as sv
from stereovox.cli import main
from stereovox.sources.calibration.camera_file import read_camera

WALL = "sim:wall?image_width=212&frames=10&subpixel=0.01&barrel=0.1&distance={}"
QUIET = "sim:wall?image_width=212&frames=10&distance={}"


def run(*words):
    return main([str(word) for word in words])


def last_json(capsys):
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def spread_of_the_wall(map_folder):
    """Extent of the hit cells along the optical axis (the world's x)."""
    return np.ptp(sv.load_map(map_folder).occupied()[:, 0])


def test_a_calibrated_camera_makes_a_flat_wall(tmp_path, capsys):
    camera, report = tmp_path / "camera.toml", tmp_path / "a" / "report"
    words = ["--distance", 1.4, "--check", WALL.format(2.5), "--check-distance", 2.5, "--out", camera]
    assert run("calibrate", "wall", WALL.format(1.4), *words, "--report", report, "--json") == 0
    told = last_json(capsys)
    assert told["model"] == "scale"
    assert told["out"] == str(camera)
    near, checked = told["walls"]
    assert near["before_percent"] > 4 > 0.3 > near["after_percent"]
    assert (near["fitted"], checked["fitted"]) == (True, False)
    assert checked["before_percent"] > 4 > 0.3 > checked["after_percent"]
    assert (report / "wall.png").read_bytes().startswith(b"\x89PNG")
    page = (report / "wall.html").read_text()
    assert "data:image/png;base64," in page
    assert f"{near['before_percent']:.2f} %" in page
    assert "sim:wall?image_width=212&amp;frames=10" in page, "texts are escaped"

    found = read_camera(camera)
    assert found.correction.model == "scale"
    assert found.correction.coefficients[3] == pytest.approx(0.096, abs=0.004)
    assert WALL.format(1.4) in camera.read_text()
    common = ["--voxel-size", 0.05, "--set", "noise.subpixel=0.01"]
    source = WALL.format(1.4)
    assert run("map", source, "--out", tmp_path / "bent", *common) == 0
    assert run("map", source, "--out", tmp_path / "flat", "--camera", camera, *common) == 0
    assert spread_of_the_wall(tmp_path / "bent") > 0.14
    assert spread_of_the_wall(tmp_path / "flat") < 0.06


def test_a_measured_profile_is_what_the_map_uses(tmp_path, capsys):
    profile, report = tmp_path / "mine.toml", tmp_path / "report"
    walls = [QUIET.format(distance) for distance in (1, 2, 4)]
    assert run("calibrate", "noise", *walls, "--out", profile, "--report", report, "--json") == 0
    told = last_json(capsys)
    true = 0.08 / (told["focal_px"] * 0.05)
    assert told["s2"] == pytest.approx(true, rel=0.05)
    assert [round(point["distance_m"], 1) for point in told["points"]] == [1, 2, 4]
    assert (report / "noise.png").read_bytes().startswith(b"\x89PNG")
    assert f"{1000 * told['points'][2]['rmse_m']:.2f}" in (report / "noise.html").read_text()
    assert run("map", QUIET.format(1), "--frames", ":2", "--out", tmp_path / "m", "--profile", profile) == 0
    noise = sv.load_map(tmp_path / "m").config.noise
    assert (noise.s0, noise.s1, noise.s2) == (told["s0"], told["s1"], told["s2"])


def test_correlation_goes_into_the_profile_and_the_map_uses_it(tmp_path, capsys):
    profile, report = tmp_path / "mine.toml", tmp_path / "report"
    walls = [QUIET.format(f"{distance}&correlation=1.5") for distance in (1, 2)]
    options = ["--terms", "s2", "--region", "2x1.2", "--out", profile, "--report", report, "--json"]
    assert run("calibrate", "noise", *walls, *options) == 0
    told = last_json(capsys)
    assert told["correlation_px"] == pytest.approx(1.5, rel=0.1)
    assert told["points"][0]["looks"] < 5
    assert f"{told['correlation_px']:.2f} px" in (report / "noise.html").read_text()
    assert run("map", walls[0], "--frames", ":2", "--out", tmp_path / "m", "--profile", profile) == 0
    assert sv.load_map(tmp_path / "m").config.noise.correlation_px == told["correlation_px"]


def test_conditions_are_compared(tmp_path, capsys):
    """Light is what makes noise and holes here: twice the noise, and a camera with holes."""
    walls = [QUIET.format("1&subpixel=0.05"), QUIET.format(2), QUIET.format("1&camera=d435&subpixel=0.1")]
    words = [word for name in ("bright", "bright", "dark & dull") for word in ("--condition", name)]
    report = tmp_path / "report"
    options = ["--terms", "s2", "--out", tmp_path / "p.toml", "--report", report, "--json"]
    assert run("calibrate", "noise", *walls, *words, *options) == 0
    out = capsys.readouterr().out
    bright, dark = json.loads(out.splitlines()[-1])["conditions"]
    assert (bright["condition"], dark["condition"]) == ("bright", "dark & dull")
    assert [round(distance) for distance in bright["distances_m"]] == [1, 2]
    assert bright["subpixel"] == pytest.approx(np.sqrt((0.05**2 + 0.08**2) / 2), rel=0.05)
    assert dark["subpixel"] > 1.2 * bright["subpixel"]
    assert dark["valid_share"] < bright["valid_share"]
    assert bright["grey"] is None
    assert "dark &amp; dull" in (report / "noise.html").read_text()
    assert run("calibrate", "noise", *walls, *words[:2], *options) == 2
    assert "3 recordings but 1 x --condition" in capsys.readouterr().err


def test_options_of_noise(tmp_path, capsys):
    camera = tmp_path / "camera.toml"
    walls = [WALL.format(distance) for distance in (1, 2)]
    assert run("calibrate", "wall", walls[0], "--distance", 1, "--out", camera) == 0
    fixed = []
    for words in ([], ["--camera", camera]):
        options = ["--region", "9x9", "--terms", "s0,s2", "--out", tmp_path / "p.toml", "--json", *words]
        assert run("calibrate", "noise", *walls, *options) == 0
        told = last_json(capsys)
        assert told["s1"] == 0
        fixed.append(told["points"][0]["fixed_m"])
    assert fixed[0] > 5 * fixed[1], "what is corrected is no error"


def test_a_correction_that_is_there_already_does_not_count(tmp_path, capsys):
    """A second calibration of the same folder must not build on the first."""
    folder = tmp_path / "wall"
    folder.mkdir()
    bent = 1.5 * (1 + 0.1 * ((np.arange(80) - 39.5) / 39.5) ** 2) * np.ones((60, 1))
    for i in range(10):
        write_png(folder / f"frame-{i:06d}.depth.png", np.rint(1000 * bent).astype(np.uint16))
    (folder / "camera-intrinsics.txt").write_text("60 0 39.5 0 60 29.5 0 0 1")
    out = folder / "camera.toml"
    written = []
    for _ in range(2):
        assert run("calibrate", "wall", folder, "--distance", 1.5, "--out", out) == 0
        written.append(read_camera(out).correction)
    assert written[0] == written[1]
    assert written[0].coefficients[3] == pytest.approx(0.1 / (39.5 / 60) ** 2, rel=0.01)


WRONG = [
    ("the following arguments are required: wall|noise|pair", []),
    ("'wal'", ["wal"]),
    ("RECORDING", ["wall", "--out", "{tmp}/c.toml"]),
    ("required: --out", ["wall", "{wall}"]),
    ("did you mean '--distance'", ["wall", "{wall}", "--distence", "1", "--out", "{tmp}/c.toml"]),
    ("ends in .toml", ["wall", "{wall}", "--out", "{tmp}/c.txt"]),
    ("there is no folder", ["wall", "{wall}", "--out", "{tmp}/no/c.toml"]),
    ("is a folder", ["wall", "{wall}", "--out", "{tmp}/folder.toml"]),
    ("is a file", ["noise", "{wall}", "--out", "{tmp}/c.toml", "--report", "{tmp}/file"]),
    ("1 recording but 2 x --distance", ["wall", "{wall}", *["--distance", "1"] * 2, "--out", "{tmp}/c.toml"]),
    ("0 recordings but 1 x --check-distance", ["wall", "{wall}", "--check-distance", "1", "--out", "{tmp}/c.toml"]),
    ("--distance -1", ["wall", "{wall}", "--distance", "-1", "--out", "{tmp}/c.toml"]),
    ("not near 3 m", ["wall", "{wall}", "--distance", "3", "--out", "{tmp}/c.toml"]),
    ("did you mean 'thesis'", ["wall", "{wall}", "--model", "tesis", "--out", "{tmp}/c.toml"]),
    ("no flat wall in view", ["wall", "sim:aisle?image_width=212", "--out", "{tmp}/c.toml"]),
    ("leans by", ["noise", "sim:wall?image_width=212&turn=24", "--out", "{tmp}/c.toml"]),
    ("no valid depth", ["noise", "sim:wall?image_width=212&distance=0.12", "--out", "{tmp}/c.toml"]),
    ("no such folder", ["noise", "{tmp}/nothing", "--out", "{tmp}/c.toml"]),
    ("fit less with --terms s2", ["noise", "{wall}", "--out", "{tmp}/c.toml"]),
    ("--region 3", ["noise", "{wall}", "--region", "3", "--out", "{tmp}/c.toml"]),
    ("--terms s3", ["noise", "{wall}", "--terms", "s3", "--out", "{tmp}/c.toml"]),
    ("there is no folder", ["pair", "{tmp}/pair", "--out", "{tmp}/no/pair.toml"]),
    ("too few distances for --model", ["wall", "{wall}", "--model", "scale+disparity", "--out", "{tmp}/c.toml"]),
    ("shows no noise at all", ["noise", "{wall}&noise=0", "--terms", "s2", "--out", "{tmp}/c.toml"]),
    ("nothing.toml", ["noise", "{wall}", "--camera", "{tmp}/nothing.toml", "--out", "{tmp}/c.toml"]),
]


@pytest.mark.parametrize(("said", "words"), WRONG, ids=[said for said, _ in WRONG])
def test_wrong_use_ends_in_one_line(tmp_path, capsys, said, words):
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "pair").mkdir()
    (tmp_path / "pair" / "pair.toml").write_text("")
    wall = "sim:wall?image_width=212&frames=2"
    assert run("calibrate", *(word.format(tmp=tmp_path, wall=wall) for word in words)) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith("stereovox: ")
    assert said in line
    assert captured.out == ""
    assert not (tmp_path / "c.toml").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_cannot_be_written_is_told_before_the_work(tmp_path, capsys):
    tmp_path.chmod(0o500)
    try:
        assert run("calibrate", "wall", "no/recording", "--out", tmp_path / "c.toml") == 2
    finally:
        tmp_path.chmod(0o700)
    assert "cannot be written to" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["wall", "noise", "pair"])
def test_help_names_an_example(kind, capsys):
    with pytest.raises(SystemExit) as stopped:
        run("calibrate", kind, "--help")
    assert stopped.value.code == 0
    assert f"stereovox calibrate {kind}" in capsys.readouterr().out
