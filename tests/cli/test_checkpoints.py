# SPDX-License-Identifier: Apache-2.0
"""Maps that are saved while they grow: when, on full disks, and in runs that are killed."""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereovox.cli import main
from stereovox.errors import MapFileError, StereovoxError
from stereovox.mapper import GridMapper, Mapper
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.files.lock import only_writer_in, only_writer_of
from stereovox.runs import engine, recording
from stereovox.runs.engine import REST, Checkpoints

ROOT = Path(__file__).resolve().parents[2]
SOURCE = "sim:room?image_width=64&frames=30"
COARSE = ["--voxel-size", "0.4", "--max-range", "4"]


def mapped(out, *more, source=SOURCE):
    return main(["map", source, "--out", str(out), *COARSE, *more])


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


class Clock:
    """Seconds that pass only when a test says so."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.mark.parametrize(("save_takes", "gap"), [(0.0, 10.0), (0.4, 10.0), (2.0, 2.0 * REST)])
def test_saves_come_when_they_are_due_and_never_take_more_than_their_share(save_takes, gap):
    clock, saved = Clock(), []

    def save():
        saved.append(clock.now)
        clock.now += save_takes

    checkpoints = Checkpoints(save, "m", 10.0, clock)
    start = clock.now
    for frame in range(1, 4001):
        clock.now += 0.1
        checkpoints.after(frame)
    assert saved[0] - start == pytest.approx(10.0, abs=0.11)
    np.testing.assert_allclose(np.diff(saved), gap + save_takes, atol=0.11)
    assert save_takes * len(saved) <= 0.04 * (clock.now - start)


def test_without_seconds_nothing_is_saved_before_the_end():
    clock, saved = Clock(), []
    checkpoints = Checkpoints(lambda: saved.append(1), "m", 0, clock)
    clock.now += 1e9
    checkpoints.after(5)
    assert saved == []
    checkpoints.save(5)
    assert saved == [1]


@pytest.mark.parametrize("seconds", ["-1", "nan", "inf"])
def test_seconds_that_cannot_be_are_one_line(tmp_path, capsys, seconds):
    assert mapped(tmp_path / "m", f"--checkpoint={seconds}") == 2
    assert f"checkpoint_s {seconds}: give seconds, or 0" in capsys.readouterr().err
    assert names(tmp_path) == []


def test_a_save_that_fails_tells_what_is_saved():
    def save():
        if broken:
            raise MapFileError("m: no room")

    broken = False
    checkpoints = Checkpoints(save, "m", 1.0)
    broken = True
    with pytest.raises(StereovoxError, match=r"^m: no room; nothing of this run is saved$"):
        checkpoints.save(3)
    broken = False
    checkpoints.save(4)
    broken = True
    with pytest.raises(StereovoxError, match=r"^m: no room; m holds this run up to frame 4$"):
        checkpoints.save(5)


def at_each_frame(monkeypatch, out, look):
    """Call `look(number)` before each frame is added, with a checkpoint after every frame."""
    add, number = Mapper.add, [0]

    def looking(self, frame):
        look(number[0])
        number[0] += 1
        return add(self, frame)

    monkeypatch.setattr(Mapper, "add", looking)
    monkeypatch.setattr("stereovox.runs.engine.REST", 0)
    return ["--checkpoint", "1e-9"]


def test_the_map_is_there_from_the_start_and_holds_each_frame_that_was_saved(tmp_path, monkeypatch):
    seen = []

    def look(number):
        found, manifest = load_map(tmp_path / "m").history, json.loads((tmp_path / "m" / "manifest.json").read_text())
        seen.append((found.frames, manifest["last_frame"] and manifest["last_frame"]["number"]))
        assert found.last_frame is None if number == 0 else found.last_frame[0].endswith(f" frame {number - 1}")
        assert len(names(tmp_path / "m")) == 3  # one set of cells, the manifest, the lock

    assert mapped(tmp_path / "m", *at_each_frame(monkeypatch, tmp_path / "m", look)) == 0
    assert seen == [(0, None), *((n, n) for n in range(1, 30))]
    manifest = json.loads((tmp_path / "m" / "manifest.json").read_text())
    assert manifest["last_frame"]["number"] == 30
    assert manifest["last_frame"]["stamp_ns"] == load_map(tmp_path / "m").viewpoint.stamp_ns
    assert names(tmp_path) == ["m"]


def test_an_older_map_stays_until_the_first_frame_that_counts(tmp_path, monkeypatch, capsys):
    assert mapped(tmp_path / "m", "--frames", ":5") == 0
    held = []
    options = at_each_frame(monkeypatch, tmp_path / "m", lambda number: held.append(load_map(tmp_path / "m").frames))
    assert mapped(tmp_path / "m", *options, "--frames", ":3") == 0
    assert held == [5, 1, 2]


def test_refused_frames_do_not_take_the_place_of_an_older_map(tmp_path, monkeypatch):
    assert mapped(tmp_path / "m", "--frames", ":5") == 0
    held = []
    options = at_each_frame(monkeypatch, tmp_path / "m", lambda number: held.append(load_map(tmp_path / "m").frames))
    add = Mapper.add

    def first_three_refused(self, frame):
        return add(self, replace(frame, fault="no_pose") if self.map.frames_refused < 3 else frame)

    monkeypatch.setattr(Mapper, "add", first_three_refused)
    assert mapped(tmp_path / "m", *options, "--frames", ":6") == 0
    assert held == [5, 5, 5, 5, 1, 2]


@pytest.mark.parametrize("seconds", ["0", "1e-9"])
def test_saves_in_between_change_nothing(tmp_path, monkeypatch, seconds):
    monkeypatch.setattr("stereovox.runs.engine.REST", 0)
    keep = ["--set", "window.size=[3, 3, 3]", "--set", "window.trigger=0.4", "--set", "window.outside=keep"]
    assert mapped(tmp_path / "a", *keep) == 0
    assert mapped(tmp_path / "b", *keep, "--checkpoint", seconds) == 0
    for one, other in zip(
        load_map(tmp_path / "a").storage.blocks(), load_map(tmp_path / "b").storage.blocks(), strict=True
    ):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("full_at", [0, 1, 7, 31])
def test_a_full_disk_ends_in_one_line_that_tells_what_is_left(tmp_path, monkeypatch, capsys, full_at, older):
    if older:
        assert mapped(tmp_path / "m", "--frames", ":2") == 0
    save, done = VoxelMap.save, []
    options = at_each_frame(monkeypatch, tmp_path / "m", lambda number: None)
    capsys.readouterr()

    def fill_up(self, path):
        if len(done) >= full_at:
            raise MapFileError(f"{path}: cannot save the map (No space left on device)")
        done.append(1)
        save(self, path)

    monkeypatch.setattr(VoxelMap, "save", fill_up)
    status = mapped(tmp_path / "m", *options)
    said = [line for line in capsys.readouterr().err.splitlines() if line.startswith("stereovox: ")]
    if older and full_at == 31:  # 30 frames and the end: an older map needs no first one
        assert (status, said) == (0, [])
        return
    assert status == 2
    assert len(said) == 1
    assert "No space left" in said[0]
    held = full_at if older else full_at - 1
    if held > 0:
        assert f"holds this run up to frame {held}" in said[0]
        assert load_map(tmp_path / "m").frames == held
    else:
        assert "holds this run" not in said[0]
        assert names(tmp_path) == (["m"] if older else [])
        assert not older or load_map(tmp_path / "m").frames == 2


def test_a_tile_without_room_saves_what_there_is(tmp_path, monkeypatch, capsys):
    add, done = Mapper.add, []

    def no_room(self, frame):
        if len(done) == 12:
            raise MapFileError(".m-tiles: a tile cannot be written (No space left on device)")
        done.append(1)
        return add(self, frame)

    monkeypatch.setattr(Mapper, "add", no_room)
    assert mapped(tmp_path / "m") == 2
    assert "a tile cannot be written (No space left on device); " in (said := capsys.readouterr().err)
    assert "m holds this run up to frame 12" in said
    assert load_map(tmp_path / "m").frames == 12


def test_going_on_with_other_frames_is_refused(tmp_path, capsys):
    assert mapped(tmp_path / "m", "--frames", ":20:2") == 0
    before = load_map(tmp_path / "m").storage.blocks()
    assert mapped(tmp_path / "m", "--resume") == 2
    assert "frame 18', but here it is" in (said := capsys.readouterr().err)
    assert "choose frames as before" in said
    for one, other in zip(load_map(tmp_path / "m").storage.blocks(), before, strict=True):
        np.testing.assert_array_equal(one, other)
    assert mapped(tmp_path / "m", "--resume", "--frames", "::2") == 0
    assert load_map(tmp_path / "m").frames == 15


def test_the_end_tells_what_was_refused_and_when_frames_were_believed_again(tmp_path, monkeypatch, capsys):
    add, done = Mapper.add, []

    def far_away_from_the_tenth_on(self, frame):
        done.append(frame)
        pose = frame.T_world_sensor.copy()
        pose[0, 3] += 100 * (len(done) > 10)
        return add(self, replace(frame, T_world_sensor=pose))

    monkeypatch.setattr(Mapper, "add", far_away_from_the_tenth_on)
    assert mapped(tmp_path / "m", "--json", "--set", "trust.settle_s=0.2") == 0
    out, said = capsys.readouterr()
    told = json.loads(out)
    refused = told["refused"]["pose_jump"]
    assert f"{30 - refused} frames mapped, {refused} refused" in said
    assert f"  {refused} x pose_jump, first: " in said
    assert "  1 x frames of 'camera' are accepted again after pose_jump\n" in said
    assert told["settled"] == {"frames of 'camera' are accepted again after pose_jump": 1}


@pytest.mark.parametrize("resume", [False, True])
def test_a_second_writer_is_refused_before_any_work(tmp_path, monkeypatch, capsys, resume):
    assert mapped(tmp_path / "m", "--frames", ":2") == 0
    monkeypatch.setattr(recording.MapRun, "_prepare", lambda *_: pytest.fail("worked"))
    refused = []

    def second():
        refused.append(mapped(tmp_path / "m", *(["--resume"] if resume else [])))

    with only_writer_in(tmp_path / "m"):
        run_in_thread(second)
    assert refused == [2]
    assert f"{tmp_path / 'm'}: is being written by another run" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["grid", "slam"])
def test_a_second_writer_of_a_floor_is_refused_before_any_work(tmp_path, monkeypatch, capsys, command):
    monkeypatch.setattr("stereovox.runs.floor.open_robot", lambda _: pytest.fail("worked"))
    monkeypatch.setattr("stereovox.opening.open_robot", lambda _: pytest.fail("worked"))
    refused = []
    with only_writer_of(tmp_path / "floor.yaml"):
        run_in_thread(lambda: refused.append(main([command, "sim:floor", "--out", str(tmp_path / "floor.yaml")])))
    assert refused == [2]
    assert "floor.yaml: is being written by another run" in capsys.readouterr().err


def run_in_thread(action):
    """Run while another thread holds the lock."""
    import threading

    thread = threading.Thread(target=action)
    thread.start()
    thread.join()


def test_tiles_of_a_dead_run_are_in_nobodys_way(tmp_path):
    keep = ["--set", "window.size=[3, 3, 3]", "--set", "window.trigger=0.4", "--set", "window.outside=keep"]
    left = tmp_path / ".m-tiles"
    (left / "c" / "1").mkdir(parents=True)
    for name in (".lock", "zarr.json", "c/1/1.partial"):
        (left / name).write_text("")
    assert mapped(tmp_path / "m", *keep) == 0
    assert names(tmp_path) == ["m"]


def test_cells_of_a_dead_run_go_even_where_there_is_nothing_left_to_do(tmp_path, capsys):
    assert mapped(tmp_path / "m", "--frames", ":3") == 0
    whole = names(tmp_path / "m")
    (tmp_path / "m" / "cells-0123456789ab" / "coords").mkdir(parents=True)
    assert mapped(tmp_path / "m", "--frames", ":3", "--resume") == 0
    assert "already holds all 3 frames" in capsys.readouterr().err
    assert len(names(tmp_path / "m")) == len(whole)
    assert not (tmp_path / "m" / "cells-0123456789ab").exists()


def test_runs_that_are_killed_leave_maps_that_open_and_can_be_gone_on_with():
    script, kills = ROOT / "benchmarks" / "kill.py", 2  # one of each kind
    words = [sys.executable, script, "--kills", str(kills), "--frames", ":40", "--json"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    assert found["kills"] == found["opened"] == found["resumed_equal"] == kills
    assert found["checkpoints_lost"] == found["with_things_left_after_resume"] == 0


@pytest.mark.usefixtures("obeys_signals")
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_told_to_stop_saves_what_there_is(tmp_path, monkeypatch, capsys, stop):
    def look(number):
        if number == 12:
            signal.raise_signal(stop)

    at_each_frame(monkeypatch, tmp_path / "m", look)
    before = signal.getsignal(stop)
    assert mapped(tmp_path / "m", "--checkpoint", "0") == 128 + stop
    assert signal.getsignal(stop) == before
    assert capsys.readouterr().err.endswith(
        f"stopped after 13 frames; they are saved in {tmp_path / 'm'}, continue with resume (--resume)\n"
        "stereovox: stopped\n"
    )
    assert load_map(tmp_path / "m").frames == 13


@pytest.mark.usefixtures("obeys_signals")
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("save", [0, 1])
def test_a_save_is_not_cut_off_by_a_signal(tmp_path, monkeypatch, save, stop):
    """Neither the first nor the last one; `timeout` sends SIGTERM twice."""
    real, saves = VoxelMap.save, []

    def told_to_stop(self, path):
        if len(saves) == save:
            for _ in range(1 if stop == signal.SIGINT else 2):
                signal.raise_signal(stop)
        saves.append(path)
        real(self, path)

    monkeypatch.setattr(VoxelMap, "save", told_to_stop)
    status = mapped(tmp_path / "m", "--checkpoint", "0")
    assert (status, load_map(tmp_path / "m").frames) == ((128 + stop, 1) if save == 0 else (0, 30))


@pytest.mark.usefixtures("obeys_signals")
def test_a_floor_that_is_told_to_stop_is_saved(tmp_path, monkeypatch, capsys):
    add = GridMapper.add

    def told_to_stop(self, seen):
        signal.raise_signal(signal.SIGTERM)
        return add(self, seen)

    monkeypatch.setattr(GridMapper, "add", told_to_stop)
    drive = "sim:floor?plan=testbed&seconds=2&scan_hz=2&depth_hz=2&image_width=80"
    assert main(["grid", drive, "--poses", "odometry", "--out", str(tmp_path / "floor.yaml")]) == 143
    assert "stopped after 1 of" in capsys.readouterr().err
    assert names(tmp_path) == ["floor.pgm", "floor.yaml"]


@pytest.mark.usefixtures("obeys_signals")
def test_the_first_ctrl_c_waits_for_the_save_that_is_being_made():
    with engine.interrupt_between_steps() as check:
        saved = []
        signal.raise_signal(signal.SIGINT)
        Checkpoints(lambda: saved.append(1), "m", 1.0).save(1)
        assert saved == [1]
        with pytest.raises(KeyboardInterrupt):
            check()
        with pytest.raises(KeyboardInterrupt):  # a second one is obeyed at once
            signal.raise_signal(signal.SIGINT)
