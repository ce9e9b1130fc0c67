# SPDX-License-Identifier: Apache-2.0
"""The benchmark of accuracy: truths against slow references, libraries as they decide, rows, means, page, command."""

import json
import sys
from importlib.util import find_spec
from types import SimpleNamespace

import made_seen
import made_street
import numpy as np
import pytest
from made_frames import a_frame

import stereovox as sv
from stereovox.cli import main
from stereovox.errors import ConfigError, MissingExtra, SourceError, StereovoxError
from stereovox.evaluate.lidar_truth import lidar_truth
from stereovox.evaluate.truth import exact_occupancy, indices, keys, position
from stereovox.evaluate.truth_cells import TruthCells
from stereovox.geometry.se3 import look_at
from stereovox.simulate.simulation import Simulation
from stereovox_lab.bench.peers import find_peer
from stereovox_lab.benchmark import data as data_module
from stereovox_lab.benchmark.data import DEPTH, LIDAR, Task, tasks_of
from stereovox_lab.benchmark.libraries import find_libraries
from stereovox_lab.benchmark.run import judged, means, run_benchmark
from stereovox_lab.benchmark.seen import END, FREE, Seen, truth_of
from stereovox_lab.report.benchmark import COLUMNS, benchmark_page, rows_of

SMALL = "sim:box?image_width=96&frames=4"
CAMERA = sv.PinholeCamera(12, 9, 9.0, 9.0, 5.5, 4.0)


class Oracle:
    """A peer that needs no library and says of two cells what its class was given."""

    occupied_above, about, package = 0.6, "as told", "numpy"
    told = ((0, 0, 0), 2.0), ((1, 0, 0), -2.0)

    def __init__(self, voxel_size):
        self.points = 0

    def insert(self, points, origin):
        self.points += len(points)

    def counts(self):
        return 1, 1

    def bytes(self):
        return 64

    def cells(self):
        return np.array([cell for cell, _ in self.told]), np.array([level for _, level in self.told])


@pytest.fixture
def oracle(monkeypatch):
    monkeypatch.setitem(sys.modules, "a_made_oracle", SimpleNamespace(Oracle=Oracle, Blind=Blind))
    return "a_made_oracle:Oracle"


class Blind:
    """A peer whose cells cannot be read."""

    def __init__(self, voxel_size): ...

    def insert(self, points, origin): ...

    def counts(self): ...

    def bytes(self): ...


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("margin", [(0.0, 0.0), (2.0, 0.02)])
def test_what_depth_images_see_agrees_with_the_slow_reference(seed, margin):
    random = np.random.default_rng(seed)
    seen, ends, free = Seen(0.3, 3.0, margin), set(), set()
    cells = [tuple(cell) for cell in (np.argwhere(np.ones((24, 24, 24))) - 12).tolist()]
    for _ in range(2):
        depth = random.choice([0.0, np.inf, 1.1, 2.3, 2.9, 4.0], (9, 12))
        depth *= 1 + 0.1 * random.random((9, 12))
        T = look_at(random.uniform(-0.4, 0.4, 3), random.uniform(-3, 3, 3))
        seen.add(depth, CAMERA, T)
        found = made_seen.looked(depth, CAMERA, T, 0.3, 3.0, margin, cells)
        ends |= {cell for cell, what in found.items() if what == "end"}
        free |= {cell for cell, what in found.items() if what == "free"}
    near = {tuple(cell) for cell in indices(seen.cells(END)).tolist()}
    assert ends - free <= near
    assert {tuple(cell) for cell in indices(seen.cells(FREE)).tolist()} == free - ends
    assert {tuple(cell) for cell in indices(seen.cells(FREE | END)).tolist()} == free & ends
    assert len(free - ends) > 30


def test_the_truth_of_a_simulation_is_its_geometry_where_it_was_seen():
    first, second = tasks_of(SMALL, 0.1, 3.0, seeds=(5, 6))
    scene = exact_occupancy(Simulation(SMALL).scene, 0.1)
    surface, air = (first.truth.cells[first.truth.occupied == wanted] for wanted in (True, False))
    assert (position(surface, scene.surface) >= 0).all()
    assert (position(air, scene.surface) < 0).all()
    assert (position(air, scene.inside) < 0).all()
    assert len(surface) > 100
    assert len(air) > 1000
    assert first.about()["truth_sha256"] == second.about()["truth_sha256"]
    assert (first.run, second.run, len(first.frames)) == ("seed 5", "seed 6", 4)
    assert not np.array_equal(first.frames[0].depth, second.frames[0].depth)
    (named,) = tasks_of(f"{SMALL}&seed=5", 0.1, 3.0)
    assert np.array_equal(named.frames[0].depth, first.frames[0].depth)


class Listed:
    """A source of given frames."""

    name = "listed"

    def __init__(self, frames):
        self.frames = frames

    def __len__(self):
        return len(self.frames)

    def frame(self, i):
        return self.frames[i]


def test_every_tenth_frame_judges_the_map_of_the_others(monkeypatch):
    frames = [a_frame(i, wall=4.0 if i == 15 else 2.0) for i in range(23)]
    monkeypatch.setattr(data_module, "open_source", lambda location: Listed(frames))
    (task,) = tasks_of("some/folder")
    assert (task.name, task.kind, task.held_out, len(task.frames)) == ("some/folder", DEPTH, 2, 21)
    assert [frame.stamp_ns for frame in task.frames] == [i for i in range(23) if i not in (5, 15)]
    # frame 5 ends at a wall at 2.05 m, where frame 15 sees through to one at 4.15 m; both end at the box at 1.6 m
    assert task.dropped > 500
    surface = (indices(task.truth.cells[task.truth.occupied]) + 0.5) * task.voxel_size
    number = {name: int((np.abs(surface[:, 0] - x) < 0.11).sum()) for name, x in
              (("box", 1.6), ("wall", 2.05), ("far", 4.15))}  # fmt: skip
    assert number["box"] > 50
    assert number["far"] > 1000
    assert number["wall"] < 0.2 * task.dropped
    assert len(surface) == sum(number.values())
    air = (indices(task.truth.cells[~task.truth.occupied]) + 0.5) * task.voxel_size
    assert air[:, 0].max() < 4.15 - 2 * task.voxel_size - 0.02 * 4
    with pytest.raises(StereovoxError, match="give at least 10"):
        list(tasks_of("listed", frames=":5"))
    with pytest.raises(SourceError, match="selects none"):
        list(tasks_of("listed", frames="90:"))


def test_a_lidar_is_the_truth_where_there_is_one(tmp_path, monkeypatch):
    made_street.sharpen(monkeypatch)
    drive = str(made_street.raw(tmp_path, 3))
    (task,) = tasks_of(drive, 0.5, 20.0)
    wanted, _ = lidar_truth(sv.open_source(drive), 0.5, 20.0, "rays")
    assert (task.kind, task.held_out, len(task.frames)) == (LIDAR, 0, 3)
    cells, log_odds = wanted.cells()
    assert np.array_equal(indices(task.truth.cells), cells)
    assert np.array_equal(task.truth.occupied, log_odds > 0)
    assert all(frame.depth.shape == (96, 256) for frame in task.frames)
    ((ours,), _) = find_libraries(["stereovox"])
    assert judged(ours, task)["auc"] > 0.8


def test_frames_are_thinned_evenly(monkeypatch):
    frames = [a_frame(i) for i in range(50)]
    monkeypatch.setattr(data_module, "open_source", lambda location: Listed(frames))
    (task,) = tasks_of("listed", most_frames=11)
    assert [frame.stamp_ns for frame in task.frames] == [0, 5, 10, 15, 20, 29, 34, 39, 44, 49]


def made_task(occupied, free, frames=3):
    truth = TruthCells(truth_of(keys(occupied), keys(free), 0.5, 5.0))
    return Task("made", "", LIDAR, 0.5, 5.0, [a_frame(i) for i in range(frames)], truth)


def test_a_library_is_judged_at_its_own_threshold(oracle, monkeypatch):
    ((library,), missing) = find_libraries([oracle])
    assert (missing, library.settings, library.version) == ([], "as told", f"numpy {np.__version__}")
    task = made_task([[0, 0, 0], [5, 0, 0]], [[1, 0, 0], [2, 0, 0]])
    row = judged(library, task)
    assert (row["iou"], row["coverage"], row["wrongly_free"], row["map_bytes"]) == (0.5, 0.5, 0.0, 64)
    assert row["thin_lost"] == 0.5
    assert row["decisions"]["surface_unknown"] == 0.5
    assert row["ms"] >= 0
    level = np.log(0.55 / 0.45)  # below its 0.6: free, though more likely occupied than not
    monkeypatch.setattr(Oracle, "told", (((0, 0, 0), level), ((5, 0, 0), 0.5)))
    row = judged(library, task)
    assert (row["decisions"]["surface_free"], row["decisions"]["surface_occupied"]) == (0.5, 0.5)
    assert row["wrongly_free_alone"] == 0.5


def test_ours_is_judged_as_the_map_that_the_mapper_makes():
    ((library,), _) = find_libraries(["stereovox"])
    task = made_task([[3, 0, 2]], [[1, 0, 2]], frames=5)
    contestant = library.make(task)
    mapper = sv.Mapper(voxel_size=0.5, max_range=5.0)
    for frame in task.frames:
        contestant.add(frame)
        mapper.add(frame)
    ours, wanted = contestant.map().cells(), mapper.map.cells()
    assert all(np.array_equal(a, b) for a, b in zip(ours, wanted, strict=True))
    assert len(contestant.ms) == 5


@pytest.mark.parametrize("name", ["octomap", "pyoctomap"])
def test_cells_of_octomap_are_those_it_counts(name):
    if not find_spec(name):
        pytest.skip(f"{name} not installed: pip install 'stereovox[bench]'")
    frame = a_frame()
    peer = find_peer(name)(0.1)
    valid = frame.depth > 0
    points = frame.camera.back_project(frame.depth * 0.001)[valid] @ frame.T_world_sensor[:3, :3].T
    points = points + frame.T_world_sensor[:3, 3]
    peer.insert(np.ascontiguousarray(points), frame.T_world_sensor[:3, 3].copy())
    cells, log_odds = peer.cells()
    assert (int((log_odds > 0).sum()), int((log_odds < 0).sum())) == peer.counts()
    wall = np.floor(points / 0.1).astype(int)
    hit = {tuple(cell) for cell in cells[log_odds > 0].tolist()}
    assert hit == {tuple(cell) for cell in wall.tolist()}
    assert log_odds.max() == pytest.approx(np.log(0.7 / 0.3), abs=1e-3)


def test_libraries_that_cannot_take_part_are_named(oracle, monkeypatch):
    with pytest.raises(ConfigError, match="unknown peer 'octopus'"):
        find_libraries(["octopus"])
    with pytest.raises(ConfigError, match="lacks cells"):
        find_libraries([oracle.replace("Oracle", "Blind")])
    with pytest.raises(StereovoxError, match="nosuch"):
        find_libraries(["stereovox:nosuch"])
    with pytest.raises(ConfigError, match="name at least one"):
        find_libraries([])
    monkeypatch.setitem(sys.modules, "octomap", None)
    with pytest.raises(MissingExtra):
        find_libraries(["octomap"])
    found, missing = find_libraries(None)
    assert found[0].name == "stereovox"
    assert any(line.startswith("octomap: ") for line in missing)


def test_means_spread_and_the_best_of_each_column():
    names = list(COLUMNS)
    made = [
        {"library": "a", "data": "x", "run": "1", **dict.fromkeys(names, 0.2)},
        {"library": "b", "data": "x", "run": "1", **dict.fromkeys(names, 0.3)},
        {"library": "a", "data": "x", "run": "2", **dict.fromkeys(names, 0.4) | {"thin_lost": None}},
        {"library": "b", "data": "x", "run": "2", **dict.fromkeys(names, 0.5)},
    ]
    first, second = means(made)
    assert (first["library"], first["runs"], first["auc"], second["auc"]) == ("a", 2, pytest.approx(0.3), 0.4)
    assert (first["thin_lost"], first["spread"]["ece"]) == (0.2, pytest.approx(0.2))
    rows = {row[0]: dict(zip(names, row[1:], strict=True)) for row in rows_of({"means": [first, second]}, "x")}
    assert (rows["a"]["auc"], rows["b"]["auc"]) == ("0.300", "0.400*")
    assert (rows["a"]["ece"], rows["b"]["ece"]) == ("0.300*", "0.400")
    assert (rows["a"]["wrongly_free"], rows["a"]["thin_lost"]) == ("30.00*", "20.0*")


def test_a_run_tells_all_that_repeats_it(oracle):
    result = run_benchmark([SMALL], ["stereovox", oracle], voxel_size=0.1, max_range=3.0, seeds=(7, 8), command="c <x>")
    assert result["protocol"]
    assert [one["name"] for one in result["libraries"]] == ["stereovox", oracle]
    assert [(row["library"], row["run"]) for row in result["rows"]] == [
        (name, f"seed {seed}") for seed in (7, 8) for name in ("stereovox", oracle)
    ]
    assert len(result["means"]) == len(result["data"]) == 2
    ours = result["means"][0]
    assert ours["auc"] > 0.9
    assert ours["f_score_2"] > 0.5
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    page = benchmark_page(result)
    assert "c &lt;x&gt;" in page
    assert result["data"][0]["truth_sha256"][:12] in page
    assert f"{ours['auc']:.3f}" in page
    assert all(column.head.replace(">", "&gt;") in page for column in COLUMNS.values())
    assert "{{" not in page


def test_the_command_prints_a_table_and_writes_page_and_figures(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["benchmark", SMALL, "--libraries", "stereovox", "--seed", "9", "--voxel-size", "0.1", "--max-range", "3"]
    assert main([*words, "--out", "b", "--json"]) == 0
    captured = capsys.readouterr()
    told = json.loads(captured.out)
    assert told["command"].startswith(f"stereovox benchmark '{SMALL}' --libraries stereovox")
    assert told["command"].endswith("--seed 9")
    assert (tmp_path / "b" / "benchmark.html").read_text().count("<table>") >= 6
    saved = json.loads((tmp_path / "b" / "benchmark.json").read_text())
    assert saved["rows"] == told["rows"]
    assert f"{told['means'][0]['auc']:.3f}" in captured.err
    assert "truth: exact geometry" in captured.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nosuchfolder"], "nosuchfolder"),
        ([SMALL, "--libraries", "octopus"], "octopus"),
        ([SMALL, "--libraries", "stereovox", "--frames", "9:"], "selects none"),
        ([SMALL, "--libraries", "stereovox", "--voxel-size", "-1"], "voxel_size"),
        ([SMALL, "--libraries", "stereovox", "--most-frames", "0"], "most-frames"),
    ],
)
def test_mistakes_are_one_line(words, said, capsys):
    assert main(["benchmark", *words]) == 2
    err = capsys.readouterr().err.splitlines()
    assert said in err[-1]
    assert err[-1].startswith("stereovox: ")


def test_bench_and_benchmark_point_at_each_other(capsys):
    for command, other in (("bench", "benchmark"), ("benchmark", "bench")):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        assert f"`{other}`" in capsys.readouterr().out
