# SPDX-License-Identifier: Apache-2.0
"""`stereovox bench` as a user runs it: the built-in scene, files, more measurements, classes of one's own, Ctrl-C."""

import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_recordings import write_png

from stereovox.cli import main
from stereovox.errors import StereovoxError
from stereovox_lab.bench import more
from stereovox_lab.bench.results import Table
from stereovox_lab.cli import bench as command

SPEED = Path(__file__).parents[3] / "docs/speed.md"


@pytest.fixture
def recording(tmp_path):
    """A 7-Scenes folder of three images: a wall 2 m away with a box before it."""
    folder = tmp_path / "wall"
    folder.mkdir()
    np.savetxt(folder / "camera-intrinsics.txt", [[60.0, 0, 39.5], [0, 60.0, 29.5], [0, 0, 1]])
    depth = np.full((60, 80), 2000, np.uint16)
    depth[20:40, 30:50] = 1200
    for i in range(3):
        write_png(folder / f"frame-{i:06d}.depth.png", depth)
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", np.eye(4))
    return folder


def run(*words):
    return main(["bench", *map(str, words)])


def test_without_a_source_the_built_in_room_is_used(monkeypatch, capsys):
    assert command.BUILT_IN == "sim:room?frames=60"
    monkeypatch.setattr(command, "BUILT_IN", "sim:room?frames=3&image_width=64")
    assert run("--voxel-size", 0.2, "--peers", "", "--json") == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (told["source"], told["frames"], told["image"]) == ("sim:room?frames=3&image_width=64", 3, "64x36")


def test_files_hold_what_is_printed(recording, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("stereovox_lab.bench.machine.cores", lambda: 3)
    out = tmp_path / "a" / "bench"
    sizes = ["--voxel-size", 0.2, "--voxel-size", 0.1]
    assert run(recording, *sizes, "--peers", "", "--integrators", "projective,ray", "--out", out, "--json") == 0
    captured = capsys.readouterr()
    told = json.loads(captured.out.splitlines()[-1])
    assert json.loads((out / "bench.json").read_text()) == told
    assert [(row["library"], row["threads"]) for row in told["rows"]] == [("stereovox", 1)] * 2
    variants = [("stereovox", 3), ("stereovox-ray", 1), ("stereovox-ray", 3)]
    assert [(row["library"], row["threads"]) for row in told["variants"]] == variants * 2
    page = (out / "bench.md").read_text()
    for row in [*told["rows"], *told["variants"]]:
        for text in (captured.err, page):
            assert re.search(
                rf"{row['library']}[ |]+{row['threads']}[ |]+3[ |]+{row['integrate_ms_median']:.2f}[ |]", text
            )
    assert told["machine"]["cpu"] in page
    picture = (out / "bench.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert int.from_bytes(picture[16:20]) > 1200
    assert f"written into {out}: bench.json, bench.md, bench.png" in captured.err


def test_threads_are_one_row_where_they_are_named(recording, capsys):
    assert run(recording, "--voxel-size", 0.2, "--peers", "", "--threads", 2, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["threads"] for row in told["rows"]] == [2]
    assert told["variants"] == []


def fake(name, calls, stop=False):
    def measure(given):
        calls.append((name, given))
        if stop:
            raise KeyboardInterrupt
        return {"figure": 42}

    def table(result):
        return Table(f"Table of {name}", ("what", "figure"), [[(name, str(result["figure"]))]])

    return more.Measurement("a fake", measure, table)


def test_more_is_measured_and_told(recording, tmp_path, capsys, monkeypatch):
    calls = []
    for name in more.MEASUREMENTS:
        monkeypatch.setitem(more.MEASUREMENTS, name, fake(name, calls))
    words = [recording, "--voxel-size", 0.2, "--peers", "", "--out", tmp_path / "b", "--json"]
    assert run(*words, "--also", "path,map-size", "--frames-long", 777, "--most-cells", 50000) == 0
    captured = capsys.readouterr()
    assert [name for name, _ in calls] == ["map-size", "path"]
    given = calls[0][1]
    assert (given.path_frames, given.most_cells, given.voxel_sizes) == (777, 50000, [0.2])
    assert len(given.recording.frames) == 3
    told = json.loads(captured.out)
    assert told["more"] == {"map-size": {"figure": 42}, "path": {"figure": 42}}
    assert "Table of path" in captured.err
    assert "## Table of map-size" in (tmp_path / "b" / "bench.md").read_text()
    calls.clear()
    assert run(*words, "--all") == 0
    assert [name for name, _ in calls] == list(more.MEASUREMENTS)


def test_help_names_every_measurement(capsys):
    with pytest.raises(SystemExit):
        run("--help")
    said = " ".join(capsys.readouterr().out.split()).replace("- ", "-")
    assert all(name in said for name in more.MEASUREMENTS)
    page = SPEED.read_text()
    assert all(f"| `{name}` |" in page for name in more.MEASUREMENTS)


def test_ctrl_c_leaves_what_is_done(recording, tmp_path, capsys, monkeypatch):
    calls = []
    monkeypatch.setitem(more.MEASUREMENTS, "threads", fake("threads", calls))
    monkeypatch.setitem(more.MEASUREMENTS, "overhead", fake("overhead", calls, stop=True))
    out = tmp_path / "bench"
    words = [recording, "--voxel-size", 0.2, "--peers", "", "--also", "threads,overhead", "--out", out]
    assert run(*words) == 130
    said = capsys.readouterr().err
    assert f"stopped; this much is done and written into {out}" in said
    assert "Table of threads" in said
    told = json.loads((out / "bench.json").read_text())
    assert list(told["more"]) == ["threads"]
    assert len(told["rows"]) == 1
    assert "Table of threads" in (out / "bench.md").read_text()
    assert (out / "bench.png").exists()


def test_ctrl_c_before_anything_is_done_leaves_nothing(recording, tmp_path, capsys, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("stereovox_lab.bench.frames.read_frames", stop)
    assert run(recording, "--peers", "", "--out", tmp_path / "bench") == 130
    assert capsys.readouterr().err.splitlines()[-1] == "stereovox: stopped"
    assert list((tmp_path / "bench").iterdir()) == []


def test_the_toy_of_the_page_runs(recording, tmp_path):
    """As the page says: saved next to where the command is run, in a process of its own."""
    example = next(code for code in re.findall(r"```python\n(.*?)```", SPEED.read_text(), re.DOTALL) if "Toy" in code)
    (tmp_path / "toy_peer.py").write_text(example)
    words = ["bench", str(recording), "--peers", "toy_peer:Toy", "--voxel-size", "0.1", "--json"]
    code = "import sys; sys.path.remove(''); "  # as for the installed command, to which the folder says nothing
    code += f"from stereovox.cli import main; sys.exit(main({words!r}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    ours, toy = json.loads(done.stdout)["rows"]
    assert (toy["library"], toy["frames"], toy["free"]) == ("toy_peer:Toy", 3, 0)
    assert toy["map_bytes"] == 24 * toy["occupied"]
    assert ours["occupied"] / 2 < toy["occupied"] < 2 * ours["occupied"]


def test_a_peer_that_fails_leaves_what_is_done(recording, tmp_path, capsys, monkeypatch):
    class Toy:
        def __init__(self, voxel_size):
            self.voxel_size = voxel_size

        def insert(self, points, origin):
            assert self.voxel_size > 0.15, "too small for me"

        def counts(self):
            return 1, 2

        def bytes(self):
            return 3

    monkeypatch.setitem(sys.modules, "toys", SimpleNamespace(Toy=Toy))
    out = tmp_path / "bench"
    assert run(recording, "--voxel-size", 0.2, "--voxel-size", 0.1, "--peers", "toys:Toy", "--out", out) == 2
    said = capsys.readouterr().err
    assert "stopped; this much is done" in said
    assert said.splitlines()[-1].startswith("stereovox: peer 'toys:Toy' at 0.1 m: AssertionError: too small for me")
    told = json.loads((out / "bench.json").read_text())
    assert [(row["library"], row["voxel_size"]) for row in told["rows"]] == [("stereovox", 0.2), ("toys:Toy", 0.2)]


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("unknown measurement 'thread' (did you mean 'threads'?)", ["--also", "thread"]),
        ("unknown integrator 'rays'", ["--integrators", "rays"]),
        ("--integrators: name at least one", ["--integrators", ""]),
        ("--frames-long 0: give at least 500", ["--also", "path", "--frames-long", 0]),
        ("--frames-long 499: give at least 500", ["--all", "--frames-long", 499]),
        ("--most-cells -5: give at least 10000", ["--also", "map-size", "--most-cells=-5"]),
        ("--frames-long goes with --also path or --all", ["--frames-long", 900]),
        ("--most-cells goes with --also map-size or --all", ["--also", "path", "--most-cells", 20000]),
        ("peer 'nowhere:Toy': No module named 'nowhere'", ["--peers", "nowhere:Toy"]),
        ("'{tmp}/file': cannot make this folder", ["--out", "{tmp}/file"]),
    ],
    ids=str,
)
def test_slips_are_one_line_before_the_work(said, words, recording, tmp_path, capsys, monkeypatch):
    def unread(*_, **__):
        raise AssertionError("a frame was asked for")

    monkeypatch.setattr("stereovox_lab.bench.frames.read_frames", unread)
    (tmp_path / "file").write_text("not a folder")
    assert run(recording, "--voxel-size", 0.2, *(str(word).format(tmp=tmp_path) for word in words)) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("compiling")]
    assert len(lines) == 1
    assert lines[0].startswith(f"stereovox: {said.format(tmp=tmp_path)}")


def test_a_measurement_that_fails_leaves_what_is_done(recording, tmp_path, capsys, monkeypatch):
    def fail(given):
        raise StereovoxError("no process could be started")

    broken = more.Measurement("a fake", fail, more.MEASUREMENTS["start-up"].table)
    monkeypatch.setitem(more.MEASUREMENTS, "start-up", broken)
    out = tmp_path / "bench"
    assert run(recording, "--voxel-size", 0.2, "--peers", "", "--also", "start-up", "--out", out) == 2
    said = capsys.readouterr().err
    assert "stopped; this much is done" in said
    assert said.splitlines()[-1] == "stereovox: no process could be started"
    assert len(json.loads((out / "bench.json").read_text())["rows"]) == 1
