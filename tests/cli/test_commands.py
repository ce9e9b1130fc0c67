# SPDX-License-Identifier: Apache-2.0
"""Every command as a user runs it: what it prints, what it leaves behind, how it fails."""

import json
import os
import shlex
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from made_recordings import write_png

import stereovox as sv
from stereovox import VoxelMap, load_config
from stereovox.cli import COMMANDS, _parse, command_module, commands, main
from stereovox.mapper import Mapper


def write_recording(folder: Path, frames: int = 6) -> Path:
    """A 7-Scenes folder: a camera that faces along z a wall 2 m away with a box before it."""
    folder.mkdir()
    np.savetxt(folder / "camera-intrinsics.txt", [[60.0, 0, 39.5], [0, 60.0, 29.5], [0, 0, 1]])
    depth = np.full((60, 80), 2000, np.uint16)
    depth[20:40, 30:50] = 1200
    depth[:5] = 0
    for i in range(frames):
        pose = np.eye(4)
        pose[0, 3] = 0.02 * i + 0.013
        write_png(folder / f"frame-{i:06d}.depth.png", depth)
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)
    return folder


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "my recording")


def run(*words):
    return main([str(word) for word in words])


def last_json(capsys):
    out = capsys.readouterr().out
    return json.loads(out.splitlines()[-1])


def fails_with_one_line(capsys, said, *words):
    assert run(*words) == 2
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if not line.startswith(("note: ", "compiling "))]
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("stereovox: ")
    assert said in lines[0]
    assert captured.out == ""


def test_map_then_everything_else(recording, tmp_path, capsys):
    out = tmp_path / "wall map.svox"
    assert run("map", recording, "--out", out, "--voxel-size", 0.1, "--json") == 0
    told = last_json(capsys)
    assert told["frames"] == 6
    assert told["frames_refused"] == 0
    assert told["refused"] == {}
    assert set(told["integrate_ms"]) == set(told["depth_ms"]) == {"median", "p90", "p99", "max"}
    assert told["occupied"] > 100
    assert told["free"] > 1000
    assert told["memory_bytes"] > 0

    assert run("info", out, "--json") == 0
    info = last_json(capsys)
    assert info["voxel_size"] == 0.1
    assert info["frames"] == 6
    assert info["profile"] == "default"
    assert (info["occupied"], info["free"]) == (told["occupied"], told["free"])
    assert np.shape(info["bounds"]) == (2, 3)
    loaded = sv.load_map(out)
    assert loaded.state([[0.05, 0.0, 1.25], [0.05, 0.0, 0.55]]).tolist() == [sv.State.OCCUPIED, sv.State.FREE]

    assert run("picture", out, tmp_path / "wall.png", "--up=-y", "--json") == 0
    assert (tmp_path / "wall.png").read_bytes().startswith(b"\x89PNG")
    for ending in ("bt", "ot", "ply", "npz"):
        assert run("export", out, tmp_path / f"wall.{ending}") == 0
        assert (tmp_path / f"wall.{ending}").stat().st_size > 100


def test_frames_settings_and_integrators(recording, tmp_path, capsys):
    common = ["--voxel-size", 0.1, "--set", "sensor.p_right=0.8", "--set", "map.log_odds_max=2.5", "--json"]
    for name in ("projective", "ray"):
        out = tmp_path / f"{name}.svox"
        assert run("map", recording, "--out", out, "--integrator", name, "--frames", "::2", *common) == 0
        assert last_json(capsys)["frames"] == 3
        config = sv.load_map(out).config
        assert config.integrator == name
        assert config.sensor.parameters() == {"p_right": 0.8}
        assert config.map.log_odds_max == 2.5
        assert sv.load_map(out).cells()[1].max() <= 2.5


def test_resume_equals_one_run(recording, tmp_path, capsys):
    bad = recording / "frame-000001.pose.txt"
    bad.write_text("nan " * 16)
    assert run("map", recording, "--out", tmp_path / "whole", "--voxel-size", 0.1) == 0
    assert run("map", recording, "--out", tmp_path / "parts", "--voxel-size", 0.1, "--frames", ":3") == 0
    assert run("map", recording, "--out", tmp_path / "parts", "--resume", "--json") == 0
    assert last_json(capsys)["frames"] == 3
    whole, parts = sv.load_map(tmp_path / "whole"), sv.load_map(tmp_path / "parts")
    assert all((a == b).all() for a, b in zip(whole.storage.blocks(), parts.storage.blocks(), strict=True))
    assert (parts.frames, parts.frames_refused) == (whole.frames, whole.frames_refused) == (5, 1)
    assert run("map", recording, "--out", tmp_path / "parts", "--resume") == 0
    assert "already holds all 6 frames" in capsys.readouterr().err
    assert (sv.load_map(tmp_path / "parts").storage.blocks()[1] == whole.storage.blocks()[1]).all()
    fewer = ["map", recording, "--out", tmp_path / "parts", "--resume", "--frames", ":4"]
    fails_with_one_line(capsys, "holds 6 frames, more than the 4", *fewer)
    other_size = ["--resume", "--voxel-size", 0.2]
    fails_with_one_line(capsys, "voxel_size 0.1", "map", recording, "--out", tmp_path / "parts", *other_size)


def test_resume_with_another_recording_is_refused(recording, tmp_path, capsys):
    other = write_recording(tmp_path / "another")
    out = tmp_path / "m"
    assert run("map", recording, "--out", out, "--voxel-size", 0.1, "--frames", ":3") == 0
    capsys.readouterr()
    fails_with_one_line(capsys, "'my recording', not of 'another'", "map", other, "--out", out, "--resume")
    assert sv.load_map(out).frames == 3


def test_bad_frames_are_counted_by_reason(recording, tmp_path, capsys):
    image = recording / "frame-000002.depth.png"
    image.write_bytes(image.read_bytes()[:100])
    (recording / "frame-000003.pose.txt").write_text("1 0 0 0  0 1 0 0  0 0 2 0  0 0 0 1")
    assert run("map", recording, "--out", tmp_path / "m", "--voxel-size", 0.1, "--json") == 0
    captured = capsys.readouterr()
    told = json.loads(captured.out.splitlines()[-1])
    assert told["frames"] == 4
    assert told["refused"] == {"unreadable": 1, "pose_not_rigid": 1}
    assert "frame-000002.depth.png" in captured.err


def test_nothing_but_bad_frames_writes_no_map(recording, tmp_path, capsys):
    for pose in recording.glob("*.pose.txt"):
        pose.write_text("0 " * 16)
    fails_with_one_line(capsys, "one frame could be used", "map", recording, "--out", tmp_path / "m")
    assert not (tmp_path / "m").exists()


def test_ctrl_c_saves_what_there_is(recording, tmp_path, capsys, monkeypatch):
    add, done = Mapper.add, []

    def add_three(self, frame):
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(frame)
        return add(self, frame)

    monkeypatch.setattr(Mapper, "add", add_three)
    assert run("map", recording, "--out", tmp_path / "m", "--voxel-size", 0.1) == 130
    assert "--resume" in capsys.readouterr().err
    assert sv.load_map(tmp_path / "m").frames == 3


MISTAKES = [
    ("did you mean 'map'", ["mpa"]),
    ("--help", []),
    ("required: PATH", ["info"]),
    ("no such folder", ["map", "/no/such/recording", "--out", "m"]),
    ("no recording itself; did you mean", ["map", "{tmp}", "--out", "{tmp}/m"]),
    ("did you mean 'voxel_size'", ["map", "{rec}", "--out", "{tmp}/m", "--set", "voxel_sise=1"]),
    ("write KEY=VALUE", ["map", "{rec}", "--out", "{tmp}/m", "--set", "voxel_size"]),
    ("use --profile", ["map", "{rec}", "--out", "{tmp}/m", "--set", "profile=x"]),
    ("greater than 0", ["map", "{rec}", "--out", "{tmp}/m", "--voxel-size", "-1"]),
    ("invalid float", ["map", "{rec}", "--out", "{tmp}/m", "--voxel-size", "small"]),
    ("did you mean 'projective'", ["map", "{rec}", "--out", "{tmp}/m", "--integrator", "projectiv"]),
    ("did you mean 'stereo'", ["map", "{rec}", "--out", "{tmp}/m", "--set", "sensor.model=stero"]),
    ("unknown profile", ["map", "{rec}", "--out", "{tmp}/m", "--profile", "chien"]),
    ("is not a slice", ["map", "{rec}", "--out", "{tmp}/m", "--frames", "1-5"]),
    ("selects none", ["map", "{rec}", "--out", "{tmp}/m", "--frames", "90:"]),
    ("not a stereovox map", ["map", "{rec}", "--out", "{rec}"]),
    ("no map to continue", ["map", "{rec}", "--out", "{tmp}/m", "--resume"]),
    ("did you mean '--threads'", ["map", "{rec}", "--out", "{tmp}/m", "--thread", "2"]),
    (
        "unknown option '--zebra' (known: --camera, --checkpoint, --close-loops, --device, --frames",
        ["map", "{rec}", "--out", "{tmp}/m", "--zebra"],
    ),
    ("unexpected argument 'extra'", ["map", "{rec}", "extra", "--out", "{tmp}/m"]),
    ("expected one argument", ["map", "{rec}", "--out"]),
    ("'--jsn' is before the command; write it after: stereovox info ... --jsn", ["--jsn", "info", "m"]),
    ("expected one argument (write --up=-y)", ["picture", "{map}", "{tmp}/x.png", "--up", "-y"]),
    ("write --eye=-1,2,3", ["picture", "{map}", "{tmp}/x.png", "--eye", "-1,2,3"]),
    ("min_range 0.1 must be smaller than max_range 0.05", ["map", "{rec}", "--out", "{tmp}/m", "--max-range", "0.05"]),
    ("stereovox: voxel_size -1.0: ", ["map", "{rec}", "--out", "{tmp}/m", "--voxel-size=-1"]),
    ("give a list of 3 numbers, [x, y, z]", ["map", "{rec}", "--out", "{tmp}/m", "--set", "window.size=20"]),
    ("a recording; make a map of it with: stereovox map ", ["view", "{rec}"]),
    ("no such folder or file", ["info", "{tmp}/gone"]),
    ("a_file", ["map", "{rec}", "--out", "{tmp}/a_file/m"]),
    ("a_file", ["demo", "--out", "{tmp}/a_file"]),
    ("a_file", ["export", "{map}", "{tmp}/a_file/x.bt"]),
    ("a_file", ["picture", "{map}", "{tmp}/a_file/x.png"]),
    ("no_folder", ["export", "{map}", "{tmp}/no_folder/x.ply"]),
    ("no_folder", ["picture", "{map}", "{tmp}/no_folder/x.png"]),
    ("'w' is no axis", ["picture", "{map}", "{tmp}/x.png", "--up", "w"]),
    ("greater than 0", ["demo", "--out", "{tmp}/d", "--voxel-size", "-1"]),
    ("unknown peer 'octomp' (did you mean 'octomap'?)", ["bench", "{rec}", "--peers", "octomp"]),
    ("greater than 0", ["bench", "{rec}", "--voxel-size", "0"]),
    ("threads 0", ["bench", "{rec}", "--threads", "0"]),
    ("no stereovox map here", ["export", "{tmp}/gone", "{tmp}/x.bt"]),
    ("pictures are .png", ["picture", "{tmp}/gone", "x.jpg"]),
    ("must be smaller", ["map", "{rec}", "--out", "{tmp}/m", "--set", "map.free_below=0.9"]),
    ("log_odds_min", ["map", "{rec}", "--out", "{tmp}/m", "--set", "map.log_odds_min=high"]),
]


@pytest.mark.parametrize(
    ("said", "words"), MISTAKES, ids=lambda value: " ".join(value) if isinstance(value, list) else ""
)
def test_mistakes_end_in_one_line(said, words, recording, tmp_path, capsys):
    (tmp_path / "a_file").write_text("not a folder")
    saved = tmp_path / "saved"
    if "{map}" in words:
        VoxelMap.from_cells(load_config(), [[0, 0, 0]], [1.0]).save(saved)
    fails_with_one_line(capsys, said, *(word.format(tmp=tmp_path, rec=recording, map=saved) for word in words))
    assert not (tmp_path / "m").exists()


def test_a_source_that_is_not_there_is_told_without_a_list_of_formats(tmp_path, capsys):
    assert run("map", tmp_path / "gone", "--out", tmp_path / "m") == 2
    assert capsys.readouterr().err == f"stereovox: {tmp_path / 'gone'}: no such folder or file; check the name\n"


def test_the_map_in_a_folder_is_suggested(tmp_path, capsys):
    VoxelMap.from_cells(load_config(), [[0, 0, 0]], [1.0]).save(tmp_path / "demo" / "room.svox")
    for words in (["info"], ["view"], ["picture", "x.png"], ["export", "x.bt"]):
        given = [words[0], tmp_path / "demo", *words[1:]]
        fails_with_one_line(capsys, f"(did you mean {tmp_path / 'demo' / 'room.svox'}?)", *given)


def test_info_tells_what_the_map_was_made_of_and_how(recording, tmp_path, capsys):
    made = ["--voxel-size", 0.1, "--integrator", "ray", "--max-range", 4, "--set", "noise.subpixel=0.1", "--profile"]
    (tmp_path / "mine.toml").write_text("[depth]\ndenoise = false\n")
    for profile, changed in (
        ("default", {"noise.subpixel": 0.1}),
        (tmp_path / "mine.toml", {"depth.denoise": False, "noise.subpixel": 0.1}),
    ):
        assert run("map", recording, "--out", tmp_path / "m", *made, profile) == 0
        capsys.readouterr()
        assert run("info", tmp_path / "m", "--json") == 0
        captured = capsys.readouterr()
        told = json.loads(captured.out)
        assert (told["recording"], told["changed"]) == ("my recording", changed)
        first, second, third, *_ = captured.err.splitlines()
        assert first.startswith("made of my recording, profile ")
        assert second == "cells of 0.1 m, ray, depth up to 4 m"
        words = third.removeprefix("changed: ").split(", ")
        assert sorted(words) == sorted(f"{name} = {value}" for name, value in changed.items())


def test_memory_of_a_window_is_told_apart(recording, tmp_path, capsys):
    window = ["--set", "window.size=[4,4,4]", "--set", "window.trigger=0.5"]
    assert run("map", recording, "--out", tmp_path / "m", "--voxel-size", 0.1, *window) == 0
    assert ", reserved for the window" in capsys.readouterr().err
    assert run("info", tmp_path / "m") == 0
    assert "in memory once loaded, in addition to its window's reserve" in capsys.readouterr().err
    assert run("map", recording, "--out", tmp_path / "n", "--voxel-size", 0.1) == 0
    assert "reserved" not in capsys.readouterr().err
    assert run("info", tmp_path / "n") == 0
    assert "window's reserve" not in capsys.readouterr().err


def test_bench_without_peers_installed_times_stereovox_and_says_what_to_install(recording, capsys, monkeypatch):
    for module in ("octomap", "pyoctomap"):
        monkeypatch.setitem(sys.modules, module, None)  # as if not installed
    assert run("bench", recording, "--voxel-size", 0.2, "--frames", ":2", "--json") == 0
    captured = capsys.readouterr()
    assert [row["library"] for row in json.loads(captured.out)["rows"]] == ["stereovox"]
    assert captured.err.count("pip install 'stereovox[bench]'") == 2
    fails_with_one_line(capsys, "pip install", "bench", recording, "--voxel-size", 0.2, "--peers", "octomap")


@pytest.fixture
def obeys_ctrl_c():
    """A process that was started in the background ignores Ctrl-C, and so would its tests."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("obeys_ctrl_c")
def test_ctrl_c_never_cuts_a_frame_in_half(recording, tmp_path, monkeypatch):
    add = Mapper.add

    def add_and_press(self, frame):
        if self.map.frames == 2:
            signal.raise_signal(signal.SIGINT)
        return add(self, frame)

    monkeypatch.setattr(Mapper, "add", add_and_press)
    assert run("map", recording, "--out", tmp_path / "m", "--voxel-size", 0.1) == 130
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.undo()
    assert run("map", recording, "--out", tmp_path / "three", "--voxel-size", 0.1, "--frames", ":3") == 0
    stopped, three = sv.load_map(tmp_path / "m"), sv.load_map(tmp_path / "three")
    assert stopped.frames == 3
    assert all((a == b).all() for a, b in zip(stopped.storage.blocks(), three.storage.blocks(), strict=True))


@pytest.mark.parametrize(
    ("error", "said"),
    [(PermissionError(13, "Permission denied", "/a/b"), "/a/b: Permission denied"), (MemoryError(), "larger cells")],
)
def test_what_no_command_foresaw_is_one_line_too(error, said, recording, tmp_path, capsys, monkeypatch):
    def fail(*_):
        raise error

    monkeypatch.setattr("stereovox.opening.open_source", fail)
    fails_with_one_line(capsys, said, "map", recording, "--out", tmp_path / "m")


@pytest.mark.parametrize("name", ["price $x^b$ _{", "größe"])
def test_any_name_can_be_drawn_and_told(name, recording, tmp_path, capsys):
    assert run("map", recording, "--out", tmp_path / name, "--voxel-size", 0.1) == 0
    capsys.readouterr()
    no_letter = os.fsdecode(b"\xff")
    words = "picture", tmp_path / name, tmp_path / "p.png", "--view", "space", "--json"
    assert run(*words, "--title", f"$\\frac $ {no_letter}") == 0
    assert run(*words) == 0
    assert last_json(capsys) == {"picture": str(tmp_path / "p.png")}


def test_the_next_command_can_be_copied(recording, tmp_path, capsys):
    assert run("map", recording, "--out", tmp_path / "it's a map.svox", "--voxel-size", 0.1) == 0
    offered = capsys.readouterr().err.splitlines()[-1].partition("with: stereovox ")[2]
    command, path, picture = shlex.split(offered)
    assert (command, path, picture) == ("picture", str(tmp_path / "it's a map.svox"), "it's a map.png")


def test_a_full_or_closed_output_is_no_traceback(recording, tmp_path):
    VoxelMap.from_cells(load_config(), [[0, 0, 0]], [1.0]).save(tmp_path / "m")
    command = f"'{sys.executable}' -m stereovox info '{tmp_path / 'm'}' --json"
    full = subprocess.run(["bash", "-c", f"{command} > /dev/full"], capture_output=True, text=True, check=False)
    assert (full.returncode, full.stderr.splitlines()[-1][:11]) == (2, "stereovox: ")
    closed = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command} | true"], capture_output=True, text=True, check=False
    )
    assert closed.returncode == 0
    assert "Traceback" not in full.stderr + closed.stderr
    assert "Exception" not in full.stderr + closed.stderr


def test_bench_prints_rows_and_ratios(recording, capsys):
    pytest.importorskip("octomap", reason="pip install 'stereovox[bench]'")
    pytest.importorskip("pyoctomap", reason="pip install 'stereovox[bench]' (no wheel for ARM)")
    sizes = ["--voxel-size", 0.2, "--voxel-size", 0.1]
    assert run("bench", recording, *sizes, "--peers", "octomap, pyoctomap", "--frames", ":3", "--json") == 0
    told = last_json(capsys)
    assert [(row["library"], row["voxel_size"]) for row in told["rows"]] == [
        (library, size) for size in (0.2, 0.1) for library in ("stereovox", "octomap", "pyoctomap")
    ]
    for row in told["rows"]:
        assert row["threads"] == 1
        assert row["integrate_ms_median"] > 0
        assert row["occupied"] > 0
        assert row["free"] > 0
        assert row["map_bytes"] > 0
    assert {size: set(peers) for size, peers in told["ratio"].items()} == {
        size: {"octomap", "pyoctomap"} for size in ("0.2", "0.1")
    }


def test_a_broken_map_file_ends_in_one_line(recording, tmp_path, capsys):
    out = tmp_path / "m"
    assert run("map", recording, "--out", out, "--voxel-size", 0.1) == 0
    (out / "manifest.json").write_text("{")
    capsys.readouterr()
    for words in (["info", out], ["picture", out, tmp_path / "p.png"], ["export", out, tmp_path / "m.bt"]):
        fails_with_one_line(capsys, "manifest.json", *words)


def test_unknown_export_names_the_known(recording, tmp_path, capsys):
    out = tmp_path / "m"
    assert run("map", recording, "--out", out, "--voxel-size", 0.1) == 0
    capsys.readouterr()
    fails_with_one_line(capsys, ".bt", "export", out, tmp_path / "m.xyz")


def test_help_of_every_command_names_an_example(capsys):
    for command in COMMANDS:
        with pytest.raises(SystemExit) as stopped:
            run(command, "--help")
        assert stopped.value.code == 0
        assert f"stereovox {command}" in capsys.readouterr().out


def test_help_and_import_stay_light():
    """The command line answers at once: heavy libraries are imported by the commands that need them."""
    code = "import sys, stereovox.cli as c\ntry: c.main(['--help'])\nexcept SystemExit: pass\n"
    code += "print([m for m in ('numba', 'cv2', 'matplotlib', 'zarr', 'trimesh', 'rich', 'scipy') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_as_a_program(recording, tmp_path):
    command = [sys.executable, "-m", "stereovox", "map", str(recording), "--out", str(tmp_path / "m"), "--json"]
    done = subprocess.run([*command, "--voxel-size", "0.1"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["frames"] == 6
    assert "6 frames mapped" in done.stderr
    version = subprocess.run(
        [sys.executable, "-m", "stereovox", "--version"], capture_output=True, text=True, check=True
    )
    assert version.stdout.strip() == f"stereovox {sv.__version__}"


def test_bench_takes_a_range(recording, capsys):
    words = ["--voxel-size", 0.2, "--frames", ":1", "--peers", ""]
    assert run("bench", recording, *words, "--max-range", 1.5, "--json") == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out.splitlines()[-1])["max_range"] == 1.5
    assert "depth up to 1.5 m" in captured.err
    fails_with_one_line(capsys, "no depth up to 1 m", "bench", recording, "--voxel-size", 0.2, "--max-range", 1)


def test_a_map_without_an_occupied_cell_asks_for_the_range(recording, tmp_path, capsys):
    common = ["map", recording, "--out", tmp_path / "m", "--voxel-size", 0.1]
    assert run(*common) == 0
    assert "note: no cell is" not in capsys.readouterr().err
    assert run(*common[:2], "--out", tmp_path / "near", "--voxel-size", 0.1, "--max-range", 0.8) == 0
    assert "note: no cell is occupied; is --max-range large enough?\n" in capsys.readouterr().err
    far = ["--set", "window.size=[4,4,4]", "--set", "window.centre=[90,0,0]"]
    assert run(*common[:2], "--out", tmp_path / "far", "--voxel-size", 0.1, *far) == 0
    assert "the camera was never in the box" in capsys.readouterr().err
    unsure = ["--frames", ":1", "--set", "map.false_alarm=1e6"]
    assert run(*common[:2], "--out", tmp_path / "unsure", "--voxel-size", 0.1, *unsure) == 0
    assert "are tentative; is --max-range large enough, map.false_alarm too large?" in capsys.readouterr().err


KINDS = ("wall", "noise", "pair", "stereo", "import")


@pytest.mark.parametrize("name", [*commands(), *(f"calibrate.calibrate_{kind}" for kind in KINDS)])
def test_examples_in_the_help_are_accepted(name, capsys):
    module = import_module(f"stereovox.cli.{name}") if "." in name else command_module(name)
    examples = module.EXAMPLES.splitlines()
    words = [shlex.split(example)[1:] for example in examples]
    assert len(examples) == len(set(examples)) == 2
    assert {given[0] for given in words} == {name.partition(".")[0]}
    for given in words:
        _parse(given)
    with pytest.raises(SystemExit):
        _parse([*words[0][: 1 + ("." in name)], "--help"])
    assert capsys.readouterr().out.splitlines()[-3:] == ["examples:", *(f"  {example}" for example in examples)]


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("stereovox ma", {"map "}),
        ("stereovox map --vox", {"--voxel-size "}),
        ("stereovox calibrate st", {"stereo "}),
        ("stereovox calibrate stereo --le", {"--lens "}),
    ],
)
def test_the_shell_completes_commands_and_options(line, expected, tmp_path):
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line))}
    answer = {"_ARGCOMPLETE_STDOUT_FILENAME": str(tmp_path / "words"), "_ARGCOMPLETE_IFS": "\n"}
    command = [sys.executable, "-c", "from stereovox.cli import main; main()"]
    done = subprocess.run(command, env={**os.environ, **asked, **answer}, capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert set((tmp_path / "words").read_text().split("\n")) == expected


def test_an_option_of_another_kind_of_command_is_refused_in_the_words_of_that_kind(capsys):
    words = "calibrate stereo boards --board 9x6 --square 0.025 --out rig.toml --distance 3"
    fails_with_one_line(capsys, "see: stereovox calibrate stereo --help", *words.split())
