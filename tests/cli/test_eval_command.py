# SPDX-License-Identifier: Apache-2.0
"""`stereovox eval`: what it prints and writes, and what it says about wrong use."""

import json

import numpy as np
import pytest

import stereovox as sv
from stereovox.cli import main
from stereovox.formats import export

CONFIG = sv.load_config(voxel_size=0.5, **{"map.prior": 0.5})
CELLS = [[x, y, 0] for x in range(6) for y in range(6)]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A truth with a wall at x = 2, and a map that has most of it one cell off."""
    truth = sv.VoxelMap.from_cells(CONFIG, CELLS, [3.0 if x == 2 else -3.0 for x, _, _ in CELLS])
    ours = [3.0 if (x, y) in ((2, 0), (3, 1), (3, 2), (3, 3), (5, 5)) else -3.0 for x, y, _ in CELLS]
    one = sv.VoxelMap.from_cells(CONFIG, CELLS, ours)
    truth.save(tmp_path / "truth.svox")
    one.save(tmp_path / "map.svox")
    export(one, tmp_path / "map.bt")
    export(truth, tmp_path / "truth.ot")
    monkeypatch.chdir(tmp_path)
    np.savetxt(tmp_path / "path.txt", [[0.25, 0.25, 0.25]])
    sv.VoxelMap.from_cells(sv.load_config(voxel_size=0.25, **{"map.prior": 0.5}), CELLS, ours).save(
        tmp_path / "fine.svox"
    )
    return tmp_path


def run(capsys, *words):
    status = main(["eval", *words])
    captured = capsys.readouterr()
    return status, captured.out, captured.err.splitlines()


@pytest.mark.parametrize(("ours", "truth"), [("map.svox", "truth.svox"), ("map.bt", "truth.ot")])
@pytest.mark.usefixtures("folder")
def test_the_measures_are_printed_and_one_object_of_json(capsys, ours, truth):
    status, out, err = run(capsys, ours, truth, "--json")
    found = json.loads(out.splitlines()[-1])
    assert status == 0
    assert [found[name] for name in ("cells", "tp", "fp", "tn", "fn")] == [36, 1, 4, 26, 5]
    assert (found["precision"], found["recall"]) == pytest.approx((1 / 5, 1 / 6))
    assert (found["tolerance_precision"], found["tolerance_recall"]) == pytest.approx((4 / 5, 5 / 6))
    assert found["observed"]["tp"] == 1
    assert any(line.split()[:3] == ["recall", "0.167", "0.167"] for line in err), err


@pytest.mark.usefixtures("folder")
def test_what_the_map_decides_comes_first(capsys):
    _, out, err = run(capsys, "map.svox", "truth.svox", "--json", "--path", "path.txt")
    found = json.loads(out)
    decided = found["decisions"]
    assert next(iter(found)) == "decisions"
    assert (decided["surface"], decided["air"], decided["occupied"], decided["free"]) == (6, 30, 5, 31)
    assert (decided["surface_occupied"], decided["surface_free"]) == pytest.approx((1 / 6, 5 / 6))
    assert decided["surface_free_alone"] == pytest.approx(1 / 6)  # the end of the wall at y = 5
    assert (decided["occupied_hit"], decided["occupied_near"]) == pytest.approx((1 / 5, 4 / 5))
    assert {part["by"] for part in decided["parts"]} == {"range", "thickness"}
    assert sum(part["surface"] for part in decided["parts"] if part["by"] == "range") == 6
    assert err[0].split() == ["what", "is", "there", "cells", "occupied", "tentative", "free", "unknown"]
    assert err[1].split() == ["a", "surface", "6", "16.7%", "0.0%", "83.3%", "0.0%"]
    assert any(line.split()[:7] == ["cells", "called", "occupied", "5", "20.0%", "hold", "a"] for line in err), err
    assert any(line.startswith("thickness: line ") for line in err), err


@pytest.mark.usefixtures("folder")
def test_threshold_and_tolerance_are_used(capsys):
    _, out, _ = run(capsys, "map.svox", "truth.svox", "--json", "--tolerance", "4", "--threshold", "0.02")
    found = json.loads(out)
    assert (found["threshold"], found["tolerance_cells"], found["fn"]) == (0.02, 4, 0)
    assert found["tolerance_precision"] == pytest.approx(1)


def test_a_report_is_written_with_distances(folder, capsys):
    words = ("--report", "report", "--path", "path.txt", "--json")
    status, out, _ = run(capsys, "map.svox", "truth.svox", *words)
    assert status == 0
    page = (folder / "report/evaluation.html").read_text()
    assert json.loads(out)["report"] == "report/evaluation.html"
    assert page.count("data:image/png") == 2
    rings = json.loads(out)["distance"]
    assert sum(ring["surface"] for ring in rings) == 6
    assert rings[0]["from_m"] == 0
    assert None in [ring["recall"] for ring in rings]
    assert "0.167" in page


def test_maps_without_a_common_cell_get_a_hint(folder, capsys):
    sv.VoxelMap.from_cells(CONFIG, [[90, 90, 90]], [1.0]).save(folder / "far.svox")
    status, _, err = run(capsys, "far.svox", "truth.svox")
    assert status == 0
    assert any("same world frame" in line for line in err)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["fine.svox", "truth.svox"], "0.25 m cannot be compared with a truth of 0.5 m"),
        (["map.svox", "absent.svox"], "absent.svox"),
        (["map.svox", "absent.bt"], "absent.bt"),
        (["map.svox", "truth.svox", "--threshold", "7"], "threshold 7.0"),
        (["map.svox", "truth.svox", "--tolerance", "99"], "tolerance 99"),
        (["map.svox", "truth.svox", "--tolerance", "half"], "half"),
        (["map.svox", "truth.svox", "--path", "map.svox"], "map.svox"),
        (["map.svox", "truth.svox", "--report", "path.txt"], "path.txt"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_mistakes_are_one_line(capsys, words, said):
    status, out, err = run(capsys, *words)
    assert (status, out) == (2, "")
    assert said in err[-1]
    assert err[-1].startswith("stereovox: ")
    assert len(err) == 1 or "--report" in words


def test_a_path_of_another_world_gets_a_hint(folder, capsys):
    hint = "the path does not fit the map; is it in the map's world frame?"
    _, _, err = run(capsys, "map.svox", "truth.svox", "--path", "path.txt")
    assert hint not in err
    np.savetxt(folder / "path.txt", [[0.25, 0.25, 0.25 + 1.4 * CONFIG.max_range]])
    assert hint not in run(capsys, "map.svox", "truth.svox", "--path", "path.txt")[2]
    np.savetxt(folder / "path.txt", [[0.25, 0.25, 0.25 + 1.6 * CONFIG.max_range]])
    status, _, err = run(capsys, "map.svox", "truth.svox", "--path", "path.txt")
    assert (status, hint in err) == (0, True)
