# SPDX-License-Identifier: Apache-2.0
"""`stereovox eval`, `info` and `picture` with floor maps in map_server files."""

import json

import numpy as np
import pytest
from made_floors import FREE, WALL, changed, looked_up, room

import stereovox as sv
from stereovox.cli import main
from stereovox.evaluate.grid_scores import score_grids
from stereovox.formats.map_server import read_map_server, write_map_server
from stereovox.geometry import se2
from stereovox.maps.occupancy import OccupancyGrid

CONTRACT = ("tp", "fp", "tn", "fn", "accuracy", "precision", "recall", "specificity", "npv", "error", "correlation")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A reference, the same seen from 40 cm and 6 degrees away, and one whose left part was never seen."""
    monkeypatch.chdir(tmp_path)
    reference = room()
    write_map_server(reference, "reference.yaml")
    moved = OccupancyGrid(reference.cells, 0.05, tuple(se2.inverse((0.4, -0.1, 0.1))))
    write_map_server(looked_up(moved, 0.05, (-1.0, -1.0, 0.0), (130, 170)), "moved.yaml")
    cells = reference.cells.copy()
    cells[:, :44] = -1
    cells[40, 60] = WALL
    write_map_server(changed(reference, cells), "half.pgm")
    sv.VoxelMap.from_cells(sv.load_config(voxel_size=0.5), [[0, 0, 0]], [1.0]).save(tmp_path / "space.svox")
    return tmp_path


def run(capsys, *words):
    status = main([*words, "--json"])
    captured = capsys.readouterr()
    return status, json.loads(captured.out.splitlines()[-1]) if captured.out else None, captured.err.splitlines()


@pytest.mark.usefixtures("folder")
def test_eval_finds_the_motion_and_tells_equation_7(capsys):
    status, found, err = run(capsys, "eval", "moved.yaml", "reference.yaml")
    assert status == 0
    assert found["eq7_percent"] < 3
    assert found["occupied_iou_tolerant"] > 0.99
    assert [found["motion"][name] for name in ("x", "y", "yaw_deg")] == pytest.approx([0.4, -0.1, 5.73], abs=0.05)
    assert set(CONTRACT) <= set(found)
    assert any(f"error {found['eq7_percent']:.2f} % (IST 2019, Eq 7)" in line for line in err), err
    parts = [found[f"eq7_{part}_percent"] for part in ("coverage", "contradiction")]
    assert sum(parts) == pytest.approx(found["eq7_percent"])
    wanted = "of it {:.2f} % coverage (only one map knows the cell) and {:.2f} % contradiction".format(*parts)
    assert any(wanted in line for line in err), err
    assert not any("hardly match" in line for line in err)
    _, stays, doubted = run(capsys, "eval", "moved.yaml", "reference.yaml", "--no-align")
    assert stays["eq7_percent"] > 20
    assert any("hardly match" in line for line in doubted)
    assert stays["motion"] == {"x": 0, "y": 0, "yaw_deg": 0}


@pytest.mark.usefixtures("folder")
def test_excluded_regions_are_taken_out(capsys):
    words = ("eval", "half.pgm", "reference.yaml", "--no-align", "--exclude", "0,0,1,4", "--exclude=1,0,2.2,4")
    _, found, err = run(capsys, *words)
    assert found["eq7_percent"] == pytest.approx(100 / (80 * 120))
    assert (found["forgiven"], found["wrongly_occupied"], found["missed"]) == (44 * 80, 1, 0)
    assert any(line.startswith("excluded: 3,520 cells, of which 3,520 differ") for line in err)
    _, far, err = run(capsys, *words[:4], "--exclude", "90,90,91,91")
    assert far["missed"] == 44 * 80
    assert any("in the reference's frame?" in line for line in err)


@pytest.mark.usefixtures("folder")
def test_tolerance_and_threshold_are_used(capsys):
    ours, theirs = read_map_server("half.yaml"), read_map_server("reference.yaml")
    _, found, _ = run(capsys, "eval", "half.yaml", "reference.yaml", "--no-align", "--tolerance", "8")
    assert found["tolerance_cells"] == 8
    wanted = score_grids(ours, theirs, align=False, tolerance=8).as_dict()
    assert found["tolerance_recall"] == pytest.approx(wanted["tolerance_recall"])
    assert found["tolerance_recall"] > score_grids(ours, theirs, align=False).occupied.tolerance_recall
    pale = changed(ours, np.where(ours.cells == WALL, 60, ours.cells))
    write_map_server(pale, "pale.png", "scale")
    counts = [run(capsys, "eval", "pale.yaml", "reference.yaml", "--no-align", *more)[1]["tp"]
              for more in ((), ("--threshold", "0.5"))]  # fmt: skip
    assert counts[0] == 0
    assert counts[1] == found["tp"]


def test_a_report_is_written(folder, capsys):
    _, found, _ = run(capsys, "eval", "half.yaml", "reference.yaml", "--no-align", "--report", "report")
    assert found["report"] == "report/evaluation.html"
    page = (folder / "report/evaluation.html").read_text()
    for part in ("", "_coverage", "_contradiction"):
        assert f"{found[f'eq7{part}_percent']:.1f} %" in page
    assert page.count("data:image/png") == 2
    assert (folder / "report/difference.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["half.yaml", "half.pgm"])
@pytest.mark.usefixtures("folder")
def test_info_tells_what_a_floor_holds(capsys, name):
    status, found, err = run(capsys, "info", name)
    assert status == 0
    assert (found["voxel_size"], found["bounds"]) == (0.05, [[2.2, 0], [6, 4]])
    assert found["unknown"] == 44 * 80
    cells = read_map_server("half.yaml").cells
    assert (found["occupied"], found["free"]) == ((cells == WALL).sum(), (cells == FREE).sum())
    assert {"memory_bytes", "frames", "profile"} <= set(found)
    assert any("known from (2.2, 0) to (6, 4) m" in line for line in err)


def test_a_picture_is_drawn(folder, capsys):
    status, found, _ = run(capsys, "picture", "half.yaml", "plan.png", "--title", "A $room")
    assert (status, found) == (0, {"picture": "plan.png"})
    assert (folder / "plan.png").stat().st_size > 10_000


def test_the_map_s_own_picture_is_not_written_over(folder, capsys):
    write_map_server(room(), "scaled.png", "scale")
    before = (folder / "scaled.png").read_bytes()
    for name in ("scaled.yaml", "scaled.png"):
        status, _, err = run(capsys, "picture", name, "./scaled.png")
        assert status == 2
        assert "holds the cells of the map" in err[-1]
    assert (folder / "scaled.png").read_bytes() == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["eval", "space.svox", "reference.yaml"], "stereovox export space.svox floor.yaml"),
        (["eval", "reference.yaml", "space.svox"], "space.svox: is no floor map"),
        (["eval", "space.svox", "space.svox", "--no-align"], "--no-align: only for floor maps"),
        (["eval", "space.svox", "space.svox", "--exclude", "0,0,1,1"], "--exclude: only for floor maps"),
        (["eval", "half.yaml", "reference.yaml", "--exclude", "0,0,1"], "'0,0,1' is not a region"),
        (["eval", "half.yaml", "reference.yaml", "--exclude", "0,0,1,inf"], "'0,0,1,inf' is not a region"),
        (["eval", "half.yaml", "reference.yaml", "--path", "p.txt"], "--path"),
        (["eval", "half.yaml", "reference.yaml", "--tolerance", "-3"], "0 to 1000"),
        (["eval", "half.yaml", "reference.yaml", "--threshold", "7"], "not a probability"),
        (["eval", "half.yaml", "nowhere.yaml"], "nowhere.yaml"),
        (["info", "nowhere.yaml"], "nowhere.yaml"),
        (["picture", "half.yaml", "plan.jpg"], "pictures are .png, .pdf or .svg"),
        (["picture", "half.yaml", "plan.png", "--view", "layer"], "always a plan"),
        (["picture", "half.yaml", "plan.png", "--up", "z"], "--up"),
    ],
)
@pytest.mark.usefixtures("folder")
def test_mistakes_are_one_line(capsys, words, said):
    assert main(words) == 2
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 1
    assert said in err[0]
