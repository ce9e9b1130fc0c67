# SPDX-License-Identifier: Apache-2.0
"""Live cameras meet poses that arrive, and become one map."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from time import sleep

import numpy as np
import pytest
from made_live import Clouds, Images, Sender, free_port, pose_at, udp_sender
from made_recordings import write_png

from stereovox.cli import main
from stereovox.config import load_config
from stereovox.depth.sphere import T_BODY_OPTICAL, surroundings
from stereovox.errors import SourceError, StereovoxError
from stereovox.formats.map_server import read_map_server
from stereovox.geometry.se3 import inverse
from stereovox.live.rig import LiveCamera, mount_of
from stereovox.live.run import LiveRun, map_live
from stereovox.live.stream import LiveStream
from stereovox.mapper import Mapper
from stereovox.maps import State, load_map
from stereovox.opening import open_source
from stereovox.products.projection import project
from stereovox.runs.pose_choice import GIVEN, TRACK
from stereovox.sources.bags.writer import BagWriter
from stereovox.sources.base import Stream
from stereovox.sources.paced import Paced
from stereovox.sources.poses.live_poses import LivePoses
from stereovox.sources.poses.poses import Poses
from stereovox.track.tracker import Tracked

SMALL = {"voxel_size": 0.1, "max_range": 4.0, "trust.max_disagreement": 1}  # its wall moves with the camera


class Keeper:
    """An observer that keeps what it sees, and can end a run."""

    def __init__(self, after=None, act=None):
        self.frames, self.reports, self.ends = [], [], []
        self._after, self._act = after, act

    def after(self, frame, report):
        self.frames.append(frame)
        self.reports.append(report)
        if self._after is not None and len(self.frames) == self._after:
            self._act()

    def finish(self):
        self.ends.append("finish")

    def close(self):
        self.ends.append("close")


def test_images_meet_the_poses_of_a_udp_stream_through_mount_and_clock(tmp_path):
    port, offset_s = free_port(), 100.0
    camera = LiveCamera(
        Images(count=20, offset_ns=100 * 10**9), "front", mount_of([0.2, 0, 0.1, 0, 0, 30]), clock_offset_s=offset_s
    )
    keeper = Keeper()
    with Sender(udp_sender(port)) as sender:
        done = map_live(camera, tmp_path / "a.svox", poses=f"udp://:{port}", observers=[keeper], **SMALL)
    mapped = [frame for frame, report in zip(keeper.frames, keeper.reports, strict=True) if not report.refused]
    assert len(mapped) >= 15
    for frame in mapped:
        assert frame.sensor == "front"
        expected = pose_at(frame.stamp_ns, sender.begin_ns) @ camera.T_body_camera
        np.testing.assert_allclose(frame.T_world_sensor, expected, atol=2e-6)
    assert done.live["cameras"]["front"]["received"] == 20
    assert done.live["poses"]["added"] > 20
    assert done.summary()["frames"] == done.map.frames == len(mapped)
    assert load_map(tmp_path / "a.svox").frames == done.map.frames
    assert done.live["latency_ms"]["since"] == "arrival"  # stamps are 100 s off this machine's clock
    assert keeper.ends == ["finish", "close"]


def test_a_lidar_is_mounted_by_its_own_axes(tmp_path):
    poses, lidar = LivePoses(), LiveCamera(Clouds(), "top", mount_of([0.2, 0, 0, 0, 0, 90]))
    with Sender(lambda stamp_ns, _: poses.add(stamp_ns, np.eye(4))):
        done = map_live(lidar, tmp_path / "a.svox", poses=poses, voxel_size=0.1, max_range=5.0)
    left, ahead = np.array([[0.25, 3.05, 0.05]]), np.array([0, 1, 0])
    assert done.map.state(left) == State.OCCUPIED
    assert (done.map.state(left - ahead), done.map.state(left + ahead)) == (State.FREE, State.UNKNOWN)
    np.testing.assert_allclose(done.map.occupied().mean(axis=0)[:2], [0.2, 3.05], atol=0.1)


def test_several_cameras_may_be_named_and_other_things_are_none(tmp_path):
    cameras = ["sim:room?frames=3&image_width=64", "sim:box?frames=3&image_width=64"]
    with LiveRun(cameras, tmp_path / "a.svox", seconds=0.1, **SMALL) as run:
        assert list(run.stream.mounts) == cameras
    for bad in (42, [None], [cameras]):
        with pytest.raises(SourceError, match="give the name of a camera"):
            LiveRun(bad, tmp_path / "b.svox")


def test_the_latency_is_counted_from_the_stamp_where_that_is_by_this_machines_clock(tmp_path):
    poses = LivePoses()
    with Sender(poses.add):
        done = map_live(Images(), tmp_path / "a.svox", poses=poses, **SMALL)
    latency = done.live["latency_ms"]
    assert latency["since"] == "stamp"
    assert 0 < latency["map"]["median"] <= latency["outputs"]["median"] < 10_000


def test_two_cameras_become_one_map_which_is_that_of_the_same_frames_in_the_same_order(tmp_path):
    cameras = [
        LiveCamera(Images("a", 15, 0.02, distance_m=2.0), "left", mount_of([0, 0.1, 0, 0, 0, 90])),
        LiveCamera(Images("b", 15, 0.03, distance_m=1.5), "right", mount_of([0, -0.1, 0, 0, 10, -90])),
    ]
    poses, keeper = LivePoses(), Keeper()
    with Sender(poses.add):
        done = map_live(cameras, tmp_path / "a.svox", poses=poses, observers=[keeper], **SMALL)
    assert {frame.sensor for frame in keeper.frames} == {"left", "right"}
    assert done.live["cameras"]["left"]["received"] == done.live["cameras"]["right"]["received"] == 15
    assert not done.live["dropped"]
    offline = Mapper(load_config("default", **SMALL))
    for frame in keeper.frames:
        offline.add(frame)
    ours, theirs = done.map, offline.map
    assert len(ours.occupied())
    np.testing.assert_array_equal(ours.occupied(), theirs.occupied())
    np.testing.assert_array_equal(ours.log_odds(ours.occupied()), theirs.log_odds(theirs.occupied()))
    assert ours.counts() == theirs.counts()


def test_an_image_whose_pose_does_not_come_is_refused_with_the_reason(tmp_path):
    poses, silent = LivePoses("the tracker"), threading.Event()

    def add(stamp_ns, T):
        if not silent.is_set():
            poses.add(stamp_ns, T)

    keeper = Keeper(8, silent.set)
    with Sender(add):
        done = map_live(Images(count=20), tmp_path / "a.svox", poses=poses, wait_s=0.1, observers=[keeper], **SMALL)
    refused = [report for report in done.reports if report.refused]
    assert {report.refused for report in refused} == {"no_pose"}
    assert 5 <= len(refused) <= 12
    assert "the tracker: needs a pose" in refused[0].detail
    assert done.map.frames == 20 - len(refused)


def test_images_before_the_first_pose_wait_and_are_counted(tmp_path):
    poses, keeper = LivePoses(), Keeper()
    images = Images(count=30)
    sender = Sender(poses.add)

    def begin():
        while len(images.stamps) < 5:
            sleep(0.01)
        sender.__enter__()

    timer = threading.Thread(target=begin)
    timer.start()
    try:
        done = map_live(images, tmp_path / "a.svox", poses=poses, wait_s=0.05, observers=[keeper], **SMALL)
    finally:
        timer.join()
        sender.__exit__()
    before = done.live["cameras"]["camera"]["before_first_pose"]
    assert before >= 1  # more on a machine that is not busy
    assert done.map.frames + done.map.frames_refused == 30 - before


@pytest.mark.parametrize("offset_s", [100, -3])
def test_a_camera_whose_clock_is_off_is_told_at_once_and_never_mapped_at_a_wrong_pose(offset_s, tmp_path):
    cameras = [
        LiveCamera(Images("a", 40), "good", mount_of([0, 0.1, 0, 0, 0, 90])),
        LiveCamera(Images("b", 40, offset_ns=offset_s * 10**9), "off", mount_of([0, -0.1, 0, 0, 0, -90])),
    ]
    poses, keeper, lines = LivePoses(), Keeper(), []
    with Sender(poses.add):
        sleep(0.05)
        done = map_live(cameras, tmp_path / "a.svox", poses=poses, observers=[keeper], notify=lines.append, **SMALL)
    assert done.live["cameras"]["good"]["received"] == 40
    mapped = [f.sensor for f, report in zip(keeper.frames, keeper.reports, strict=True) if not report.refused]
    assert set(mapped) == {"good"}
    assert {r.refused for f, r in zip(keeper.frames, keeper.reports, strict=True) if f.sensor == "off"} == {
        "clock_doubt"
    }
    (line,) = [line for line in lines if line.startswith("off: ")]
    assert f"{abs(offset_s)}"[:-1] in line
    assert "--clock-offset" in line


def test_a_camera_whose_clock_is_set_back_is_never_mapped_at_an_old_pose(tmp_path):
    class SetBack(Images):
        def __iter__(self):
            for k, image in enumerate(super().__iter__()):
                self.offset_ns = -400_000_000 if k >= 29 else 0  # of the next one
                yield image

    poses, keeper, lines = LivePoses(), Keeper(), []
    with Sender(poses.add) as sender:
        sleep(0.05)
        camera = LiveCamera(SetBack("a", 60), "front")
        map_live(camera, tmp_path / "a.svox", poses=poses, observers=[keeper], notify=lines.append, **SMALL)
    mapped = [frame for frame, report in zip(keeper.frames, keeper.reports, strict=True) if not report.refused]
    assert 20 < len(mapped) <= 31
    for frame in mapped:
        taken_ns = camera.source.stamps[int(frame.name.split()[1])]
        assert np.abs(frame.T_world_sensor - pose_at(taken_ns, sender.begin_ns) @ T_BODY_OPTICAL).max() < 0.02
    assert "was set back by this much" in lines[0]


def test_no_pose_at_all_is_an_error_and_no_map(tmp_path):
    with pytest.raises(StereovoxError, match=r"written \(3 images arrived, but no pose: the tracker\)"):
        map_live(Images(count=3), tmp_path / "a.svox", poses=LivePoses("the tracker"), wait_s=0.01, **SMALL)
    assert not (tmp_path / "a.svox").exists()


def test_a_simulation_that_cannot_be_drawn_at_its_pace_says_so(tmp_path):
    class Slow(Stream):
        def __init__(self):
            self.source = open_source("sim:box?image_width=32")
            self.name, self.camera, self.notes = self.source.name, self.source.camera, ()

        def __iter__(self):
            for k in range(6):
                sleep(0.1)
                yield self.source.frame(k)

    done = map_live(Paced(Slow()), tmp_path / "a.svox", **SMALL)
    assert done.live["cameras"]["sim:box?image_width=32"]["late"] > 0


def test_a_camera_that_fails_does_not_end_the_others(tmp_path):
    said = []
    bad = Images("bad", 3, failure=SourceError("bad: no frame for 5 s; check cable"))
    poses = LivePoses()
    with Sender(poses.add):
        done = map_live(
            [LiveCamera(bad), LiveCamera(Images("good", 20))], tmp_path / "a.svox", poses=poses, notify=said.append,
            **SMALL,
        )  # fmt: skip
    assert "bad: no frame for 5 s; check cable; the other cameras continue" in said
    assert done.live["cameras"]["bad"]["failure"].startswith("bad: no frame")
    assert done.live["cameras"]["good"]["received"] == 20


def test_each_camera_that_fails_is_told_once(tmp_path):
    said, poses = [], LivePoses()
    cameras = [Images(name, count, failure=SourceError(f"{name}: gone")) for name, count in (("a", 12), ("b", 3))]
    with Sender(poses.add):
        map_live([*cameras, Images("c", 25)], tmp_path / "a.svox", poses=poses, notify=said.append, **SMALL)
    told = [line for line in said if "gone" in line]
    assert told == ["b: gone; the other cameras continue", "a: gone; the other cameras continue"]


def test_a_camera_that_goes_silent_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr("stereovox.live.stream.REMIND_S", 0.3)
    said, told, poses = [], threading.Event(), LivePoses()

    class Silent(Images):
        def __iter__(self):
            for image in super().__iter__():
                yield image
                told.wait(60)

    def notify(line):
        said.append(line)
        if "no image has arrived" in line:
            told.set()

    with Sender(poses.add):
        done = map_live(Silent("front", 5), tmp_path / "a.svox", poses=poses, notify=notify, **SMALL)
    assert "front: no image has arrived for 0.3 s; is it still connected?" in said
    assert done.live["cameras"]["front"]["received"] == 5


def test_the_last_camera_that_fails_ends_the_run_and_the_map_is_saved(tmp_path):
    poses, keeper = LivePoses(), Keeper()
    bad = Images("bad", 5, failure=SourceError("bad: no frame for 5 s; check cable"))
    with Sender(poses.add), pytest.raises(SourceError, match="check cable"):
        map_live(bad, tmp_path / "a.svox", poses=poses, observers=[keeper], **SMALL)
    assert load_map(tmp_path / "a.svox").frames == 5
    assert keeper.ends == ["finish", "close"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("poses", [GIVEN, TRACK])
def test_a_library_that_ends_a_cameras_thread_ends_the_run(tmp_path, poses):
    """Otherwise the run would wait for images for ever."""
    with pytest.raises(StereovoxError, match="not one"):
        map_live(Images(count=2, failure=SystemExit(3)), tmp_path / "a.svox", poses=poses, **SMALL)


def test_ctrl_c_ends_the_run_with_map_and_recording(tmp_path, obeys_signals):
    poses, images = LivePoses(), Images(count=10_000)
    keeper = Keeper(6, lambda: os.kill(os.getpid(), signal.SIGTERM))
    with Sender(poses.add):
        done = map_live(
            images, tmp_path / "a.svox", poses=poses, record=tmp_path / "log.mcap", observers=[keeper], **SMALL
        )
    assert done.stopped
    assert load_map(tmp_path / "a.svox").frames == done.map.frames == 6
    assert images.closed
    assert done.live["recorded"]["images"] == 6
    assert len(open_source(tmp_path / "log.mcap")) == 6


def test_signals_act_while_no_image_comes(tmp_path, obeys_signals):
    timer = threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGTERM))
    timer.start()
    with pytest.raises(StereovoxError, match="stopped before an image could be mapped"):
        map_live(Images(count=10, period_s=1.0), tmp_path / "a.svox", poses=LivePoses(), **SMALL)
    timer.join()
    assert not (tmp_path / "a.svox").exists()


def test_a_replayed_simulation_is_its_offline_map(tmp_path):
    """With a 2-D map, distances in all directions and a recording at once, all of the same map."""
    name = "sim:room?frames=12&image_width=160"
    keeper = Keeper()
    outputs = {"grid": tmp_path / "g.yaml", "sphere": tmp_path / "s.png", "record": tmp_path / "log.mcap"}
    done = map_live(
        LiveCamera(name, "front"), tmp_path / "a.svox", observers=[keeper], heights=(0.2, 1.5), **outputs, **SMALL
    )
    assert done.poses == "given"
    offline = Mapper(load_config("default", **SMALL))
    for frame in open_source(name):
        offline.add(frame)
    np.testing.assert_array_equal(done.map.occupied(), offline.map.occupied())
    assert done.map.counts() == offline.map.counts()
    written, made = read_map_server(tmp_path / "g.yaml"), project(offline.map, (0.2, 1.5))
    occupied = made.cells > 100 * made.occupied_above
    assert (written.cells == 100).sum() == occupied.sum() > 0
    assert (tmp_path / "s.png").stat().st_size > 1000
    again = open_source(tmp_path / "log.mcap")
    for frame, recorded in zip(keeper.frames, again, strict=True):
        np.testing.assert_allclose(recorded.T_world_sensor, frame.T_world_sensor, atol=1e-9)
        np.testing.assert_array_equal(recorded.depth, frame.depth)
        assert recorded.stamp_ns == frame.stamp_ns


def test_the_distances_all_round_are_those_of_all_cameras(tmp_path):
    cameras = [
        LiveCamera(Images("a", 8, distance_m=2.0), "ahead"),
        LiveCamera(Images("b", 8, distance_m=1.0), "behind", mount_of([0, 0, 0, 0, 0, 180])),
    ]
    poses = LivePoses()
    with (
        Sender(lambda stamp_ns, T: poses.add(stamp_ns, np.eye(4))),
        LiveRun(cameras, tmp_path / "a.svox", poses=poses, **SMALL) as run,
    ):
        run.add_outputs(sphere=True)
        run.finish()
    assert run.sphere is not None
    grid, now_ns = run.sphere.grid()
    sights = surroundings(grid)
    assert sights["front"].range_m == pytest.approx(2.0, abs=0.05)
    assert sights["back"].range_m == pytest.approx(1.0, abs=0.05)
    assert sights["left"] is None
    assert now_ns == grid.stamp_ns.max()


def test_a_tracked_camera_moves_the_others(tmp_path, monkeypatch):
    """The second camera has no poses: it faces back from a mount, and sees its wall behind."""
    monkeypatch.setattr("stereovox.live.stream.UNTRACKED", 40)  # a busy machine drops none
    monkeypatch.setattr("stereovox.live.stream.LATE_S", 40.0)
    tracking = threading.Event()
    keeper = Keeper(1, tracking.set)
    front = Paced(open_source("sim:room?image_width=212", frames=":30"))
    images = Images("b", 10, 1 / 30, distance_m=1.0, begins=tracking)
    behind = LiveCamera(images, "back", mount_of([-0.1, 0, 0, 0, 0, 180]))
    cameras = [LiveCamera(front, "front"), behind]
    done = map_live(cameras, tmp_path / "a.svox", poses=TRACK, wait_s=10.0, observers=[keeper], **SMALL)
    assert done.poses == "track"
    front = [frame for frame in keeper.frames if frame.sensor == "front" and not frame.fault]
    back = [frame for frame in keeper.frames if frame.sensor == "back" and not frame.fault]
    assert len(front) >= 25
    assert len(back) >= 2
    known = Poses([frame.stamp_ns for frame in front], [frame.T_world_sensor for frame in front])
    for frame in back:
        T_world_body = known.at(frame.stamp_ns) @ inverse(T_BODY_OPTICAL)
        np.testing.assert_allclose(frame.T_world_sensor, T_world_body @ behind.T_body_camera, atol=1e-9)


def test_the_very_images_of_a_tracked_camera_are_expected_before_their_turn(monkeypatch):
    expected, added = [], []

    class Noting:
        imu_use = ""

        def __init__(self, config, camera):
            pass

        def expect(self, frame):
            expected.append(frame)

        def add(self, frame):
            assert any(frame is one for one in expected)
            added.append(frame)
            return Tracked(np.eye(4), np.eye(6))

    monkeypatch.setattr("stereovox.live.stream._LateTracker", Noting)
    monkeypatch.setattr("stereovox.live.stream.UNTRACKED", 40)  # a busy machine drops none
    assert len(list(LiveStream([LiveCamera(Images(count=4), "front")], TRACK))) == 4
    assert list(map(id, expected)) == list(map(id, added))


def test_a_tracked_map_cannot_be_resumed(tmp_path):
    poses = LivePoses()
    with Sender(poses.add):
        map_live(Images(), tmp_path / "a.svox", poses=poses, **SMALL)
    with pytest.raises(StereovoxError, match="cannot be located in a saved map"):
        map_live(Images(), tmp_path / "a.svox", poses=TRACK, resume=True)


def test_a_map_with_poses_from_elsewhere_is_resumed(tmp_path):
    poses = LivePoses()
    with Sender(poses.add):
        first = map_live(Images(), tmp_path / "a.svox", poses=poses, **SMALL)
        second = map_live(Images(), tmp_path / "a.svox", poses=poses, resume=True)
    assert second.map.frames == 20 >= first.map.frames


def test_the_command_maps_a_file_of_cameras_and_says_what_became_of_them(tmp_path, capsys):
    (tmp_path / "live.toml").write_text(
        'poses = "given"\n[[camera]]\nname = "front"\nsource = "sim:room?frames=6&image_width=160"\n'
        '[[camera]]\nname = "also"\nsource = "sim:room?frames=6&image_width=96"\nmount = [0, 0, 0, 0, 0, 0]\n'
    )
    words = ["live", str(tmp_path / "live.toml"), "--out", str(tmp_path / "a.svox"), "--json"]
    assert main([*words, "--view", "0", "--set", "voxel_size=0.1"]) == 0
    out, err = capsys.readouterr()
    result = json.loads(out.splitlines()[-1])
    assert result["frames"] == 12
    result["live"]["cameras"]["also"].pop("late", None)  # on a busy machine
    assert result["live"]["cameras"]["also"] == {"received": 6, "dropped": 0, "before_first_pose": 0}
    assert set(result["live"]["latency_ms"]["map"]) == {"median", "p90", "p99", "max"}
    assert "in a browser to see the map grow" in err
    assert "front: 6 images received, 0 dropped" in err


def test_a_recording_whose_pose_files_are_all_missing_is_tracked(tmp_path):
    for k, frame in zip(range(3), open_source("sim:room?image_width=160"), strict=False):
        write_png(tmp_path / f"frame-{k:06d}.depth.png", np.rint(1000 * np.nan_to_num(frame.depth)).astype(np.uint16))
    (tmp_path / "camera-intrinsics.txt").write_text("140 0 79.5\n0 140 59.5\n0 0 1\n")
    assert LiveStream([LiveCamera(tmp_path)]).tracked
    (tmp_path / "frame-000000.pose.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    assert not LiveStream([LiveCamera(tmp_path)]).tracked


def test_a_map_that_holds_little_of_what_came_is_no_success(tmp_path, capsys, monkeypatch):
    real = Mapper.add

    def few(self, frame):
        return real(
            self, frame if frame.name.endswith(" 0") else replace(frame, T_world_sensor=np.full((4, 4), np.nan))
        )

    monkeypatch.setattr(Mapper, "add", few)
    words = ["--out", str(tmp_path / "a.svox"), "--set", "voxel_size=0.2", "--json"]
    assert main(["live", "sim:room?frames=6&image_width=96", *words]) == 3
    out, err = capsys.readouterr()
    (doubt,) = json.loads(out.splitlines()[-1])["doubts"]
    assert (doubt["kind"], doubt["frames"], doubt["offered"]) == ("mostly_lost", 1, 6)
    assert "but only 1 of 6 images are in the map" in err.splitlines()[-1]


def _full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("step", ["write", "fsync", "replace"])
def test_what_a_full_disk_kept_from_being_written_is_told_and_the_map_is_kept(step, tmp_path, capsys, monkeypatch):
    """The disk of the outputs is full, but not the disk of the map."""
    other = tmp_path / "full"
    other.mkdir()
    if step == "write":
        monkeypatch.setattr(BagWriter, "depth", _full)
    real = {"fsync": os.fsync, "replace": Path.replace}

    def fsync(number):
        return _full() if str(other) in os.readlink(f"/proc/self/fd/{number}") else real["fsync"](number)

    def replace(path, target):
        return _full() if str(other) in str(path) else real["replace"](path, target)

    monkeypatch.setattr(os, "fsync", fsync if step != "replace" else real["fsync"])
    monkeypatch.setattr(Path, "replace", replace if step == "replace" else real["replace"])
    words = ["live", "sim:room?frames=8&image_width=96", "--out", str(tmp_path / "a.svox"), "--set", "voxel_size=0.1"]
    outputs = {"--record": other / "log.mcap", "--grid": other / "grid.yaml", "--sphere": other / "sphere.png"}
    status = main([*words, *(str(word) for pair in outputs.items() for word in pair), "--json"])
    out, err = capsys.readouterr()
    result = json.loads(out.splitlines()[-1])
    assert status == 2
    assert load_map(tmp_path / "a.svox").frames == result["frames"] == 8
    for name, file in outputs.items():
        assert not file.exists()
        failed = [why for why in result["not_written"] if why.startswith(f"{file}:")]
        assert len(failed) == 1, name
        assert f"not written: {failed[0]}" in err
    assert "recorded in" not in err
    assert "distances in all directions: " not in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["sim:room", "--mount", "1,2"], "--mount 1,2: a mount is x, y, z, roll, pitch, yaw"),
        (["sim:room", "--mount", "a,b"], "--mount a,b: write X,Y,Z,ROLL,PITCH,YAW"),
        (["sim:room", "--poses", "gps"], "poses 'gps' is unknown; give track, given, t265, udp://:5005"),
        (["sim:room", "--poses", "udp://:nine"], "udp://:nine: write udp://HOST:PORT"),
        (["sim:room", "--poses", "udp://:9?axes=enu"], "udp://:9?axes=enu: axes=enu is unknown"),
        (["sim:room", "--sphere", "a.jpg"], "--sphere a.jpg: end the file's name with .png"),
        (["sim:room", "--record", "a.zip"], "a.zip: end the name of a recording in .mcap"),
    ],
)
def test_mistakes_are_told_in_one_line(words, message, tmp_path, capsys):
    assert main(["live", *words, "--out", str(tmp_path / "a.svox")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "a.svox").exists()


def test_the_command_is_ended_by_sigterm_and_saves(tmp_path):
    command = [sys.executable, "-m", "stereovox", "live", "sim:room?image_width=96", "--out", str(tmp_path / "a.svox")]
    run = subprocess.Popen(
        [*command, "--json", "--grid", str(tmp_path / "g.yaml"), "--set", "voxel_size=0.1"], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        while not (tmp_path / "g.yaml").exists() and run.poll() is None:
            sleep(0.02)
        run.send_signal(signal.SIGTERM)
        out, err = run.communicate()
    finally:
        run.kill()
    assert run.returncode == 0, err
    result = json.loads(out.splitlines()[-1])
    assert load_map(tmp_path / "a.svox").frames == result["frames"] > 0


def test_a_realsense_camera_and_its_poses_through_pyrealsense2s_software_device(tmp_path, monkeypatch):
    rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 has no wheel for this Python", exc_type=ImportError)
    import made_realsense as made

    camera, poses = made.SoftwareCamera(rs), LivePoses("tracker")
    monkeypatch.setattr(rs, "context", lambda: camera)
    for k in range(2000):
        poses.add(made.stamp_ns(k) + 1_000_000, np.eye(4))  # between two poses each image is
    keeper = Keeper(20, lambda: os.kill(os.getpid(), signal.SIGTERM))
    with camera.sending():
        done = map_live("realsense:042?imu=off", tmp_path / "a.svox", poses=poses, observers=[keeper], **SMALL)
    assert done.map.frames == 20 - sum(bool(report.refused) for report in keeper.reports) > 10
    assert done.live["cameras"]["realsense:042?imu=off"]["received"] >= 20
    for frame in keeper.frames:
        number = int(frame.name.rpartition(" ")[2])
        np.testing.assert_array_equal(frame.depth, made.depth(number))
        assert abs(frame.stamp_ns - made.stamp_ns(number)) < 1000  # milliseconds in a float
    with pytest.raises(RuntimeError, match="not streaming"):
        camera.sensor.stop()


def test_a_realsense_camera_without_poses_is_tracked(tmp_path, monkeypatch):
    rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 has no wheel for this Python", exc_type=ImportError)
    import made_realsense as made

    camera = made.SoftwareCamera(rs)
    monkeypatch.setattr(rs, "context", lambda: camera)
    with LiveRun("realsense:042", tmp_path / "a.svox") as run:
        assert run.stream.tracked
