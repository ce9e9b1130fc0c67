# SPDX-License-Identifier: Apache-2.0
"""Threads, first frame, start-up, overhead, map size and path: each measures what it says. How fast is not tested."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from made_frames import a_recording

from stereovox import load_config
from stereovox.errors import ConfigError, StereovoxError
from stereovox.mapper import Mapper, UpdateReport
from stereovox.opening import open_source
from stereovox_lab.bench import growth, start
from stereovox_lab.bench.growth import cost_along_path, cost_by_map_size, far_blocks, path_table, ratio_of, size_table
from stereovox_lab.bench.more import MEASUREMENTS, Given, check_names
from stereovox_lab.bench.overhead import empty_frame, overhead, overhead_table, thread_scaling, thread_table
from stereovox_lab.bench.results import Table
from stereovox_lab.bench.start import first_frame, first_frame_table, start_up, start_up_table

COARSE = load_config(voxel_size=0.2)


def test_threads_are_timed_at_each_size_against_one():
    result = thread_scaling(a_recording(), [0.2, 0.1], threads=[1, 3])
    rows = result["rows"]
    assert [(row["voxel_size"], row["threads"]) for row in rows] == [(0.2, 1), (0.2, 3), (0.1, 1), (0.1, 3)]
    for one, three in (rows[:2], rows[2:]):
        assert one["faster"] == 1
        assert three["faster"] == pytest.approx(one["integrate_ms_median"] / three["integrate_ms_median"], rel=1e-2)
    assert "0.1 m" in thread_table(result).text()


def test_threads_of_all_cores_and_the_warm_up_does_not_count(monkeypatch):
    """The first pass takes a second a frame, all others as many milliseconds as threads are fewer than ten."""
    seen = []

    def add(mapper, frame):
        seen.append(mapper.config.threads)
        return UpdateReport(integrate_ms=1000.0 if len(seen) <= 12 else 10.0 - mapper.config.threads)

    monkeypatch.setattr(Mapper, "add", add)
    monkeypatch.setattr("stereovox_lab.bench.overhead.cores", lambda: 4)
    result = thread_scaling(a_recording(), [0.2])
    assert [row["integrate_ms_median"] for row in result["rows"]] == [9.0, 8.0, 7.0, 6.0]
    assert [row["faster"] for row in result["rows"]] == [1.0, 1.125, 1.286, 1.5]


def test_a_first_frame_is_cold_once_and_then_warm(monkeypatch, tmp_path):
    folders = []

    def run(given, environment):
        cache = Path(environment["STEREOVOX_CACHE"])
        folders.append((cache, cache.exists()))
        cache.mkdir(exist_ok=True)
        seconds = (9.0, 2.0, 1.5, 1.75)[len(folders) - 1]
        return {"s": seconds, "all_s": 1.5 * seconds, "add_s": seconds - 1, "last_s": 0.01, "occupied": 5}

    monkeypatch.setattr(start, "_first_frame", run)
    result = first_frame(a_recording().frames, COARSE)
    assert [there for _, there in folders] == [False, True, True, True]
    assert len({folder for folder, _ in folders}) == 1
    assert not folders[0][0].exists()
    assert (result["cold_s"], result["warm_s"]) == (9.0, 1.5)
    assert (result["cold_all_s"], result["warm_all_s"], result["compile_s"]) == (13.5, 2.25, 11.25)
    assert (result["cold_add_s"], result["warm_add_s"], result["last_add_s"]) == (8.0, 0.5, 0.01)
    lines = first_frame_table(result).text().splitlines()
    assert next(line for line in lines if line.startswith("so compiling")).split()[-2:] == ["7.50", "11.25"]


def test_the_process_of_a_first_frame_maps_five(tmp_path):
    """With this test's own kernel cache, so that nothing is compiled twice."""
    frames = 5 * a_recording().frames[:1]
    mapper = Mapper(COARSE)
    for frame in frames:
        mapper.add(frame)
    given = tmp_path / "given.pickle"
    given.write_bytes(start.pickle.dumps((COARSE, frames)))
    run = start._first_frame(given, {})
    assert run["occupied"] == mapper.map.counts()["occupied"] > 0
    assert run["all_s"] >= run["s"] > run["add_s"] > 0


@pytest.mark.usefixtures("obeys_signals")
@pytest.mark.parametrize("send", [os.kill, os.killpg])
def test_ctrl_c_leaves_no_process_and_no_folder(send, tmp_path):
    """As a terminal sends it, to all of a group, and as `kill` does, to one."""
    code = """
from made_frames import a_recording
from stereovox import load_config
from stereovox_lab.bench import start
start.FIRST_FRAME = "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
Popen = start.subprocess.Popen
def told(*words, **more):
    child = Popen(*words, **more)
    print(child.pid, flush=True)
    return child
start.subprocess.Popen = told
start.first_frame(a_recording().frames, load_config(voxel_size=0.2))
"""
    environment = {**os.environ, "TMPDIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    ) as bench:
        assert bench.stdout
        child = int(bench.stdout.readline())
        time.sleep(0.3)
        assert len(list(tmp_path.iterdir())) == 1
        send(bench.pid, signal.SIGINT)
        _, said = bench.communicate(timeout=60)
    assert said.count("Traceback") == 1  # that of the process that was stopped
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ProcessLookupError):
        os.kill(child, 0)


def test_a_process_that_fails_is_one_line(tmp_path, capfd):
    with pytest.raises(StereovoxError, match=r"^the process that adds a first frame ended with status 1; see above$"):
        start._first_frame(tmp_path / "nothing", {})
    assert "No such file" in capfd.readouterr().err


def test_start_up_runs_each_in_a_process_of_its_own():
    result = start_up(repeats=1)
    assert list(result) == ["python alone", "import stereovox", "stereovox --help"]
    assert all(0 < took["ms_min"] <= took["ms_median"] for took in result.values())
    assert result["python alone"]["ms_min"] < result["stereovox --help"]["ms_min"]
    assert "import stereovox" in start_up_table(result).text()


def test_overhead_is_that_of_images_with_one_valid_pixel():
    frame = empty_frame(64, 48)
    assert np.count_nonzero(frame.depth) == 1
    assert Mapper(COARSE, **{"trust.min_valid_share": 0}).add(frame).refused is None
    result = overhead(COARSE, repeats=3, sizes=[(8, 6), (64, 48)])
    assert [(row["width"], row["height"]) for row in result["rows"]] == [(8, 6), (64, 48)]
    for row in result["rows"]:
        assert 0 < row["add_us"] <= row["add_us_median"]
        assert row["depth_us"] + row["integrate_us"] < 1.5 * row["add_us_median"]
    assert "64x48" in overhead_table(result).text()
    assert overhead(COARSE, repeats=1, sizes=[(8, 6)])["fixed_us"] is None


def test_the_fixed_part_is_where_a_line_meets_no_pixels(monkeypatch):
    """A clock by which an image takes 40 us and 0.01 us for each of its pixels."""
    now = [0.0]

    def add(_, frame):
        now[0] += 40e-6 + 0.01e-6 * frame.depth.size
        return UpdateReport()

    monkeypatch.setattr(Mapper, "add", add)
    monkeypatch.setattr("stereovox_lab.bench.overhead.perf_counter", lambda: now[0])
    result = overhead(COARSE, repeats=2)
    assert result["fixed_us"] == pytest.approx(40, abs=0.2)
    assert result["rows"][-1]["add_us"] == pytest.approx(40 + 3072, abs=0.2)


def test_far_blocks_are_many_distinct_near_and_out_of_reach():
    positions = np.array([[0.0, 0, 1], [3, 1, 1], [2, 2, 2]])
    blocks = far_blocks(positions, COARSE, 5000)
    assert blocks.shape == (5000, 3)
    assert blocks.dtype == np.int32
    assert len(np.unique(blocks, axis=0)) == 5000
    nearest = np.clip(positions[:, None], 1.6 * blocks, 1.6 * (blocks + 1)) - positions[:, None]
    assert np.linalg.norm(nearest, axis=2).min() > 2 * COARSE.max_range
    away = np.linalg.norm((blocks + 0.5) * 1.6 - positions.mean(0), axis=1)
    shell = 5000 * 1.6**3 + 4.2 * 15**3  # metres cubed of the blocks and of what they surround
    assert away.max() < 1.3 * (shell / 4.2) ** (1 / 3)


def test_a_large_map_holds_the_cells_and_frames_do_not_touch_them():
    recording = a_recording()
    mapper = growth._large_map(recording, COARSE, 100_000)
    before = mapper.map.storage.blocks()
    assert len(before[0]) == 196
    assert mapper.map.cells()[0].shape == (196 * 512, 3)
    assert sum(mapper.map.counts().values()) == 196 * 512
    for frame in recording.frames:
        mapper.add(frame)
    after = dict(zip(map(tuple, mapper.map.storage.blocks()[0]), mapper.map.storage.blocks()[1], strict=True))
    assert len(after) > 196
    assert all((after[tuple(coords)] == values).all() for coords, values in zip(*before, strict=True))


def test_cost_by_map_size_tells_what_memory_is_too_short_for():
    result = cost_by_map_size(a_recording(), COARSE, (1000, 20_000, 10**9), memory=10**6)
    small, large, too_large = result["rows"]
    assert (small["cells"], large["cells"], too_large["cells"]) == (1024, 20_480, 10**9)
    assert large["map_bytes"] > small["map_bytes"] > 0
    assert (small["ratio"], small["skipped"]) == (1.0, "")
    assert large["ratio"] == pytest.approx(large["integrate_ms_median"] / small["integrate_ms_median"], rel=1e-2)
    assert too_large["integrate_ms_median"] is None
    assert too_large["skipped"] == "needs 7.0 GB of memory, 0.0 GB are left"
    text = size_table(result).text()
    assert "1,000,000,000 cells: skipped, needs 7.0 GB of memory, 0.0 GB are left" in text
    assert "20,480" in text


def test_no_memory_for_any_size_is_a_table_too():
    result = cost_by_map_size(a_recording(), COARSE, (10**9,), memory=0)
    assert "skipped" in size_table(result).text()


def test_the_ratio_of_a_path_is_that_of_pieces():
    random = np.random.default_rng(1)
    new = np.repeat(random.uniform(1, 2, 20), 50)  # scenes differ, and so do both times
    grown = 1.1 + 0.02 * np.repeat(np.tile([-1, 1], 10), 50)
    ratio, error, pieces = ratio_of(list(new * grown), list(new))
    assert (ratio, pieces) == (1.1, 20)
    assert error == pytest.approx(0.02 / np.sqrt(19), abs=1e-4)


@pytest.fixture
def narrow(monkeypatch):
    """Makes the images of flights narrow: what is measured on them is the same."""
    monkeypatch.setattr(growth, "open_source", lambda name: open_source(f"{name}&image_width=64"))


def test_a_path_compares_the_old_map_with_one_begun_near_the_end(narrow, monkeypatch):
    """Maps that take a microsecond more for each frame they hold."""
    told, added = [], []

    def add(mapper, frame):
        mapper.map.frames += 1
        added.append((id(mapper), frame.stamp_ns))
        return UpdateReport(integrate_ms=1.0 + 0.001 * mapper.map.frames)

    monkeypatch.setattr(Mapper, "add", add)
    result = cost_along_path(600, lambda *done: told.append(done))
    assert [row["map"] for row in result["rows"]] == ["rolling window", "unbounded"]
    assert (result["frames"], result["metres"]) == (600, 100)
    row = result["rows"][0]
    assert row["start_ms"] == pytest.approx(1.3, abs=0.01)
    assert row["end_ms"] == pytest.approx(1.4, abs=0.01)
    assert row["ratio"] == pytest.approx(np.mean([(1.3255 + n / 20) / (1.1255 + n / 20) for n in range(6)]), abs=0.001)
    assert row["pieces"] == 6
    assert told[-1] == (600, 600, "flying")
    stamps = {}
    for mapper, stamp in added:
        stamps.setdefault(mapper, []).append(stamp)
    assert sorted(map(len, stamps.values())) == [400, 400, 600, 600]
    first, *_, second = stamps.values()
    assert second == first[-400:]


def test_a_path_is_flown_straight_on_into_new_space(narrow, monkeypatch):
    monkeypatch.setattr(growth, "MAPS", {"unbounded": {"voxel_size": 0.4, "max_range": 2.0}})
    result = cost_along_path(500)
    row = result["rows"][0]
    assert row["end_bytes"] > 3 * row["start_bytes"] > 0
    assert row["ratio"] > 0
    assert "unbounded" in path_table(result).text()


def test_a_path_that_is_too_short_is_refused():
    with pytest.raises(StereovoxError, match=r"^a flight of 499 frames is too short to compare; fly at least 500$"):
        cost_along_path(499)


def test_every_measurement_has_a_table(narrow, monkeypatch):
    """All by name, as `--all` calls them, the long ones made short."""
    monkeypatch.setattr(growth, "ROUNDS", 1)
    coarse = {"voxel_size": 0.4, "max_range": 2.0}
    monkeypatch.setattr(growth, "MAPS", {name: {**settings, **coarse} for name, settings in growth.MAPS.items()})
    monkeypatch.setattr(
        start, "_first_frame", lambda *_: {"s": 1.0, "add_s": 0.5, "all_s": 1.5, "last_s": 0.1, "occupied": 1}
    )
    given = Given(a_recording(), [0.2, 0.1], path_frames=500, most_cells=10**4)
    assert given.config.voxel_size == 0.1
    for name, measurement in MEASUREMENTS.items():
        result = measurement.run(given)
        table = measurement.table(result)
        assert isinstance(table, Table), name
        assert measurement.about
        assert all(len(row) == len(table.head) for group in table.groups for row in group)
        assert all(len(line) <= 120 for line in table.text().splitlines()), name


def test_measurements_are_made_in_their_order_and_slips_are_one_line():
    assert check_names(["path", "threads", "path"]) == ["threads", "path"]
    with pytest.raises(ConfigError, match=r"^unknown measurement 'thread' \(did you mean 'threads'\?\)$"):
        check_names(["thread"])


def test_kernels_are_looked_for_where_the_environment_says(monkeypatch, tmp_path):
    """A fresh process finds an empty cache, as `first_frame` promises."""
    code = "from stereovox.kernels._jit import cache_folder; print(cache_folder(), any(cache_folder().rglob('*.nbi')))"
    with start._process(["-c", code], {"STEREOVOX_CACHE": str(tmp_path / "new")}) as child:
        said = child.communicate()[0].split()
    assert said[0].startswith(str(tmp_path / "new") + os.sep)
    assert said[1] == "False"
