# SPDX-License-Identifier: Apache-2.0
"""A robot's recording becomes a floor's map by one call from Python, with all that `stereovox grid` promises."""

import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_drives import along, drive, ring

import stereovox as sv
from stereovox.cli import main as command
from stereovox.errors import MapFileError, MissingExtra
from stereovox.formats.map_server import read_map_server
from stereovox.geometry import se2
from stereovox.localize.slam.pipeline import Slam
from stereovox.mapper import GridMapper
from stereovox.maps.grid_map import load_grid
from stereovox.opening import open_robot
from stereovox.runs import engine
from stereovox.runs import floor as floor_run

DRIVE = "sim:floor?plan=testbed&seconds=4&scan_hz=4&depth_hz=2&image_width=64"
LIDAR = {"use": "lidar", "poses": "odometry"}


def same_cells(a, b):
    np.testing.assert_array_equal(read_map_server(a).cells, read_map_server(b).cells)


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


class Seen:
    """Counts readings; does something after some."""

    def __init__(self, stop=None, then=None):
        self.reports, self._stop, self._then = [], stop, then

    def after(self, frame, report):
        self.reports.append(report)
        if len(self.reports) == self._stop:
            self._then()


def stopped():
    raise KeyboardInterrupt


def test_it_makes_the_map_of_the_command(tmp_path):
    seen, told = Seen(), []
    result = sv.map_floor(DRIVE, tmp_path / "a.yaml", **LIDAR, observers=[seen], notify=told.append)
    words = ["grid", DRIVE, "--out", str(tmp_path / "b.yaml"), "--use", "lidar", "--poses", "odometry"]
    assert command(words) == 0
    same_cells(tmp_path / "a.yaml", tmp_path / "b.yaml")
    assert names(tmp_path) == ["a.pgm", "a.yaml", "b.pgm", "b.yaml"]
    assert seen.reports == result.reports
    assert result.summary()["frames"] == result.map.frames == len(open_robot(DRIVE).scans)
    assert (result.out, result.track) == (tmp_path / "a.yaml", None)
    assert isinstance(result.map, sv.GridMap)


def test_the_way_is_found_by_slam_or_in_a_map(tmp_path):
    told, steps = [], []
    with sv.FloorRun(DRIVE, tmp_path / "a.yaml", use="lidar", notify=told.append) as going:
        found = going.find_track(lambda *step: steps.append(step))
        assert going.finish().track is found
    scans = len(open_robot(DRIVE).scans)
    assert steps[0] == (1, scans, "matching scans")
    assert "by SLAM" in told[0]
    told.clear()
    settings = {"use": "lidar", "poses": tmp_path / "a.yaml", "notify": told.append}
    made = sv.map_floor(DRIVE, tmp_path / "b.yaml", **settings, start=(0, 0, 0))
    assert len(made.track.stamps_ns) == scans
    assert told[1] == f"localising the robot in {tmp_path / 'a.yaml'}"
    assert "of the beams end within" in told[-1]
    with pytest.raises(sv.StereovoxError, match=r"start 900, 0 m, 0 degrees: lies outside of the map"):
        sv.map_floor(DRIVE, tmp_path / "b.yaml", **settings, start=(900, 0, 0))
    with pytest.raises(sv.StereovoxError, match="three finite numbers"):
        sv.map_floor(DRIVE, tmp_path / "b.yaml", **settings, start=(1, 2))


def test_after_loops_the_map_is_that_of_a_new_run_at_the_final_poses(tmp_path):
    """Cell for cell; readings that were mapped before a loop was closed would be in the wrong place."""
    pytest.importorskip("gtsam")
    round_twice = [(1, 1), (13, 1), (13, 9), (1, 9), (1, 1), (13, 1), (13, 4)]
    scans = drive(ring(), along(round_twice), drift=(1.03, 0.01), beams=91)
    robot = SimpleNamespace(name="made", notes=(), scans=scans, frames=(), truth=None)
    made = sv.map_floor(robot, tmp_path / "a.yaml", poses="slam")
    slam = Slam(made.map.config)
    live = np.array([slam.add(scan) for scan in scans])
    final = slam.finish().track
    assert np.array_equal(made.track.pose_map_base, final.pose_map_base)
    assert np.abs(final.pose_map_base - live)[:, :2].max() > 0.1
    poses = final.pose_map_base
    cells = [mapped_at(scans, way, made.map.config).occupancy().cells for way in (poses, live)]
    assert np.array_equal(made.map.occupancy().cells, cells[0])
    assert not np.array_equal(cells[0], cells[1])


def mapped_at(scans, poses, config):
    """A new mapper that has taken scans at poses (N, 3) of the robot."""
    mapper = GridMapper(config)
    for scan, pose in zip(scans, poses, strict=True):
        mapper.add(replace(scan, T_world_sensor=se2.lifted(pose) @ scan.T_base_sensor))
    return mapper


def test_without_gtsam_the_way_on_is_named(tmp_path, monkeypatch):
    def closes_a_loop(*_):
        raise MissingExtra("gtsam", "slam")

    monkeypatch.setattr("stereovox.runs.floor.slam_robot", closes_a_loop)
    with pytest.raises(sv.StereovoxError, match=r"'stereovox\[slam\]'; or continue.*--poses odometry") as error:
        sv.map_floor(DRIVE, tmp_path / "a.yaml", use="lidar")
    assert len(str(error.value)) <= 300
    assert sv.map_floor(DRIVE, tmp_path / "a.yaml", **LIDAR).map.frames


@pytest.mark.usefixtures("obeys_signals")
@pytest.mark.parametrize("then", [stopped, lambda: signal.raise_signal(signal.SIGTERM)])
def test_a_run_that_is_told_to_stop_is_saved(tmp_path, then):
    told = []
    with pytest.raises(KeyboardInterrupt):
        sv.map_floor(DRIVE, tmp_path / "a.yaml", **LIDAR, observers=[Seen(5, then)], notify=told.append, checkpoint_s=0)
    assert told[1:] == [f"stopped after 5 of 16 readings; saved in {tmp_path / 'a.yaml'}"]
    sv.map_floor(DRIVE, tmp_path / "five.yaml", **LIDAR, frames=":5")
    same_cells(tmp_path / "a.yaml", tmp_path / "five.yaml")


KILLED = f"""
import os, signal, sys
import stereovox as sv
from stereovox.runs import engine

class Kill:
    seen = 0

    def after(self, frame, report):
        self.seen += 1
        if self.seen == 6:
            os.kill(os.getpid(), signal.SIGKILL)

engine.REST = 0
sv.map_floor({DRIVE!r}, sys.argv[1], **{LIDAR!r}, observers=[Kill()], checkpoint_s=1e-9)
"""


def test_a_run_that_is_killed_leaves_its_last_checkpoint(tmp_path):
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "a.yaml")], check=False)
    assert done.returncode == -signal.SIGKILL
    sv.map_floor(DRIVE, tmp_path / "five.yaml", **LIDAR, frames=":5")
    same_cells(tmp_path / "a.yaml", tmp_path / "five.yaml")
    sv.map_floor(DRIVE, tmp_path / "a.yaml", **LIDAR, frames=":1")
    assert {name for name in names(tmp_path) if "five" not in name} == {"a.pgm", "a.yaml"}


def test_a_full_disk_ends_in_one_line_that_tells_what_is_left(tmp_path, monkeypatch):
    save, saved = GridMapper.save, []

    def fill_up(self, *where):
        if len(saved) == 3:
            raise MapFileError("a.yaml: cannot be written (No space left on device)")
        saved.append(self.map.frames)
        save(self, *where)

    monkeypatch.setattr(GridMapper, "save", fill_up)
    monkeypatch.setattr(engine, "REST", 0)
    with pytest.raises(MapFileError, match=r"No space left on device\); .*a.yaml holds this run up to frame 3$"):
        sv.map_floor(DRIVE, tmp_path / "a.yaml", **LIDAR, checkpoint_s=1e-9)
    assert saved == [1, 2, 3]
    monkeypatch.undo()
    sv.map_floor(DRIVE, tmp_path / "three.yaml", **LIDAR, frames=":3", checkpoint_s=0)
    same_cells(tmp_path / "a.yaml", tmp_path / "three.yaml")


def test_going_on_keeps_the_cells_that_are_there(tmp_path):
    settings = {**LIDAR, "mode": "raw", "voxel_size": 0.1}
    whole = sv.map_floor(DRIVE, tmp_path / "whole.yaml", **settings).map
    first = sv.map_floor(DRIVE, tmp_path / "a.yaml", **settings, frames=":8").map
    more = sv.map_floor(DRIVE, tmp_path / "a.yaml", **LIDAR, mode="raw", frames="8:", resume=True)
    assert (more.map.voxel_size, len(more.reports)) == (0.1, 8)  # the cells of the map that is gone on with
    points = np.concatenate([first.occupied(), whole.occupied()])
    assert (more.map.state(points) == whole.state(points)).mean() > 0.95  # per cents are rounded in between
    other = sv.map_floor(DRIVE, tmp_path / "b.yaml", **LIDAR, frames=":1", resume=tmp_path / "a.yaml")
    assert len(other.map.cells()[0]) >= len(more.map.cells()[0])
    with pytest.raises(sv.StereovoxError, match="SLAM starts a new frame"):
        sv.map_floor(DRIVE, tmp_path / "a.yaml", poses="slam", resume=True)


def test_what_is_wrong_is_said_in_one_line_and_leaves_the_map(tmp_path):
    out = tmp_path / "a.yaml"
    with pytest.raises(sv.StereovoxError, match="no map to continue; start without resume"):
        sv.map_floor(DRIVE, out, resume=True)
    sv.map_floor(DRIVE, out, **LIDAR)
    before = out.read_bytes(), out.with_suffix(".pgm").read_bytes()
    for source, where, more, words in (
        (DRIVE, tmp_path / "a.svox", {}, "give a name that ends in .yaml or .pgm or .png"),
        ("nowhere.bag", out, {}, "nowhere.bag: no such file"),
        (DRIVE, out, {"use": "sonar"}, "use 'sonar': give depth, lidar or both"),
        (DRIVE, out, {"frames": "99:"}, "selects none of"),
        (DRIVE, out, {"poses": "gps"}, "poses gps: give slam, odometry, or the .yaml"),
        (DRIVE, out, {"poses": "odometry", "start": (0, 0, 0)}, "is a pose in a map"),
        (DRIVE, out, {"mode": "gray"}, "no mode 'gray'"),
        (DRIVE, out, {"checkpoint_s": -1.0}, "give seconds"),
        (DRIVE, out, {"nonsense": 1}, "nonsense"),
        (Unusable(), out, LIDAR, "not one reading could be used, so no map is written"),
    ):
        with pytest.raises(sv.StereovoxError, match=words) as caught:
            sv.map_floor(source, where, **more)
        assert "\n" not in str(caught.value)
        assert "--" not in str(caught.value)
    with sv.FloorRun(DRIVE, out, **LIDAR), ThreadPoolExecutor() as pool:
        other = pool.submit(sv.map_floor, DRIVE, out, **LIDAR)
        assert "another run" in str(other.exception())
    assert (out.read_bytes(), out.with_suffix(".pgm").read_bytes()) == before
    assert names(tmp_path) == ["a.pgm", "a.yaml"]


class Unusable:
    """A custom robot that never knows its pose."""

    name, notes, frames, truth = "lost", (), (), None

    def __init__(self):
        self.scans = [replace(one, fault="no_pose") for one in list(open_robot(DRIVE).scans)[:3]]


def test_a_mapper_saves_by_the_ending_of_the_name(tmp_path):
    made = sv.map_floor(DRIVE, tmp_path / "a.yaml", **LIDAR, frames=":5")
    mapper = GridMapper(made.map.config, resume=made.map)
    mapper.save(tmp_path / "exact.npz")
    for mine, theirs in zip(load_grid(tmp_path / "exact.npz").cells(), made.map.cells(), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    mapper.save(tmp_path / "b.png")
    same_cells(tmp_path / "a.yaml", tmp_path / "b.yaml")


def test_nothing_is_looked_for_twice(tmp_path, monkeypatch):
    with sv.FloorRun(DRIVE, tmp_path / "a.yaml", use="lidar") as going:
        going.find_track()
        monkeypatch.setattr(floor_run, "slam_robot", lambda *_: pytest.fail("again"))
        assert going.finish().track is going.find_track()


@pytest.mark.parametrize(
    ("options", "settings", "compared"),
    [
        ({"poses": "odometry"}, {}, False),
        ({"poses": "odometry"}, {"trust.max_disagreement": 0.2}, True),
        ({"poses": "slam"}, {}, True),
        ({"poses": "first.yaml", "start": (0, 0, 0)}, {}, False),
        ({"resume": "first.yaml", "start": (0, 0, 0)}, {}, True),
        ({"resume": "first.yaml", "poses": "odometry"}, {}, False),
    ],
)
def test_scans_are_compared_where_poses_are_good_enough(tmp_path, monkeypatch, options, settings, compared):
    monkeypatch.chdir(tmp_path)
    sv.map_floor(DRIVE, "first.yaml", **LIDAR)
    told = []
    made = sv.map_floor(DRIVE, "a.yaml", use="lidar", notify=told.append, **options, **settings)
    assert (made.map.config.trust.max_disagreement < 1) == compared
    assert any("are not compared" in line for line in told) != compared
