# SPDX-License-Identifier: Apache-2.0
"""`map` with a window that moves with the camera."""

import json
from dataclasses import replace

import numpy as np
import pytest

from stereovox.cli import main
from stereovox.config import load_config
from stereovox.mapper import Mapper, UpdateReport
from stereovox.maps import VoxelMap, load_map
from stereovox.opening import Stream, open_source

SOURCE = "sim:flight?length=120&speed=10&frames=60"
COARSE = ["--voxel-size", "0.4", "--max-range", "4"]
WINDOW = ["--set", "window.size=[14, 14, 12]"]


def mapped(out, *options):
    assert main(["map", SOURCE, "--out", str(out), *COARSE, "--json", *options]) == 0
    return load_map(out)


def test_tiles_are_in_the_saved_map_and_gone_from_the_disk(tmp_path, capsys):
    kept = mapped(tmp_path / "kept", *WINDOW, "--set", "window.outside=keep")
    memory = json.loads(capsys.readouterr().out)["memory_bytes"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept"]
    whole = mapped(tmp_path / "whole")
    np.testing.assert_array_equal(kept.storage.blocks()[0], whole.storage.blocks()[0])
    np.testing.assert_array_equal(kept.storage.blocks()[1], whole.storage.blocks()[1])
    dropped = mapped(tmp_path / "dropped", *WINDOW)
    assert len(dropped.storage.blocks()[0]) < 0.6 * len(kept.storage.blocks()[0])
    assert memory < 10e6


def test_a_resumed_flight_ends_like_an_uninterrupted_one(tmp_path):
    options = [*WINDOW, "--set", "window.outside=keep", "--set", "window.lead_s=0.3"]
    whole = mapped(tmp_path / "whole", *options)
    mapped(tmp_path / "half", *options, "--frames", ":25")
    half = mapped(tmp_path / "half", *options, "--resume")
    for a, b in zip(half.storage.blocks(), whole.storage.blocks(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert half.frames == whole.frames


def test_a_window_too_small_for_its_trigger_is_refused(tmp_path, capsys):
    assert main(["map", SOURCE, "--out", str(tmp_path / "map"), "--set", "window.size=[1, 1, 1]"]) == 2
    assert "trigger 1.0 must be less than half" in capsys.readouterr().err


def test_a_window_too_large_for_any_memory_is_refused(tmp_path, capsys):
    assert main(["map", SOURCE, "--out", str(tmp_path / "map"), "--set", "window.size=[900, 900, 900]"]) == 2
    assert "needs 12 TB of memory" in capsys.readouterr().err


KEEP = [*WINDOW, "--set", "window.outside=keep"]


def command(out, *options, source=SOURCE):
    return main(["map", source, "--out", str(out), *COARSE, *options])


def left(tmp_path):
    return sorted(path.name for path in tmp_path.iterdir())


def test_ctrl_c_leaves_no_tiles_and_the_run_goes_on(tmp_path, monkeypatch):
    with monkeypatch.context() as stopped:
        stopped.setattr(Mapper, "add", stop_after(Mapper.add, 25))
        assert command(tmp_path / "m", *KEEP) == 130
    assert left(tmp_path) == ["m"]
    assert load_map(tmp_path / "m").frames == 25
    assert command(tmp_path / "m", "--resume") == 0
    whole = mapped(tmp_path / "whole", *KEEP)
    for a, b in zip(load_map(tmp_path / "m").storage.blocks(), whole.storage.blocks(), strict=True):
        np.testing.assert_array_equal(a, b)


def stop_after(add, number):
    done = []

    def add_some(self, frame):
        if len(done) == number:
            raise KeyboardInterrupt
        done.append(frame)
        return add(self, frame)

    return add_some


@pytest.mark.parametrize(
    "wrong", ["integrator=projectiv", "sensor.model=stero", "sensor.p_hitt=0.9", "window.trigger=100", "tiles=x"]
)
def test_a_slip_leaves_no_tiles(tmp_path, capsys, wrong):
    assert command(tmp_path / "m", *KEEP, "--set", wrong) == 2
    assert len([line for line in capsys.readouterr().err.splitlines() if line.startswith("stereovox: ")]) == 1
    assert left(tmp_path) == []


def test_resuming_with_other_cells_leaves_no_tiles(tmp_path, capsys):
    assert command(tmp_path / "m", *KEEP, "--frames", ":3") == 0
    assert command(tmp_path / "m", "--resume", "--voxel-size", "0.2") == 2
    assert "voxel_size" in capsys.readouterr().err
    assert left(tmp_path) == ["m"]


def test_frames_of_no_use_leave_no_tiles_and_the_map_as_it_was(tmp_path, monkeypatch):
    refused = UpdateReport(refused="no_pose", detail="nowhere")
    with monkeypatch.context() as lost:
        lost.setattr(Mapper, "add", lambda self, frame: refused)
        assert command(tmp_path / "none", *KEEP) == 2
        assert left(tmp_path) == []
    first = mapped(tmp_path / "m", *KEEP, "--frames", ":20")
    for wanted in (["--set", "window.size=[16,14,12]"], ["--set", "window.lead_s=0.5"]):
        monkeypatch.setattr(Mapper, "add", lambda self, frame: refused)
        assert command(tmp_path / "m", "--resume", *wanted) == 3  # not one of the frames is in the map
        for a, b in zip(load_map(tmp_path / "m").storage.blocks(), first.storage.blocks(), strict=True):
            np.testing.assert_array_equal(a, b)
    assert left(tmp_path) == ["m"]


def test_ctrl_c_before_the_first_good_frame_of_another_window_keeps_the_map(tmp_path, monkeypatch):
    first = mapped(tmp_path / "m", "--frames", ":20")
    monkeypatch.setattr(Mapper, "add", stop_after(Mapper.add, 0))
    assert command(tmp_path / "m", "--resume", *KEEP) == 130
    for a, b in zip(load_map(tmp_path / "m").storage.blocks(), first.storage.blocks(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert left(tmp_path) == ["m"]


@pytest.mark.parametrize("done", [0, 3])
def test_a_live_camera_that_is_always_refused_is_given_up(tmp_path, capsys, monkeypatch, done):
    source = open_source("sim:wall?image_width=16", ":1")
    frame = replace(source.frame(0), fault="no_pose", fault_detail="no pose here")

    class Live(Stream):
        name, camera = "realsense:1", source.camera

        def __iter__(self):
            for _ in range(1000):
                yield frame
            raise AssertionError("still asking for frames after 1000 refusals")

    out = tmp_path / "m"
    if done:
        earlier = VoxelMap.from_cells(load_config(voxel_size=0.4), [[0, 0, 0]], [1.0])
        earlier.frames, earlier.recording = done, "realsense:1"
        earlier.save(out)
    monkeypatch.setattr("stereovox.opening.open_stream", lambda *_: Live())
    assert main(["map", "realsense:", "--out", str(out), *(["--resume"] if done else [])]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "not one of 100 frames could be used" in said
    assert "no pose here" in said
    assert (f"{out} stays as it is" if done else "no map is written") in said
    assert out.exists() == bool(done)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--set", "window.size=[1e308,4,4]"], "at most 1e"),
        (["--set", "x=" + "[" * 3000], "unknown setting 'x'"),
        (["--set", "window.size=" + "[" * 3000], "window.size"),
    ],
)
def test_what_cannot_be_read_is_one_line(tmp_path, capsys, options, said):
    assert command(tmp_path / "m", *options) == 2
    assert said in capsys.readouterr().err
    assert main(["map", SOURCE, "--out", "a\0b"]) == 2
    assert "no file name holds" in capsys.readouterr().err
