# SPDX-License-Identifier: Apache-2.0
"""Outputs of a growing map: files of the 2-D map that are rewritten, recordings that do not delay the map."""

import json
import sys
import threading
from dataclasses import replace
from subprocess import PIPE, Popen

import numpy as np
import pytest
from floor_obstacles import built_in, score, truth_of
from made_live import CAMERA, wall

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.depth.sphere import T_BODY_OPTICAL
from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.formats.map_server import read_map_server
from stereovox.frame import Frame, Photo, UpdateReport
from stereovox.frame.stamp_clock import epoch_ns
from stereovox.live.outputs import GridFile, Latency, LiveSphere
from stereovox.live.recorder import WAITING, Recorder, optical, topic
from stereovox.live.stream import Moment
from stereovox.mapper import Mapper
from stereovox.opening import open_source
from stereovox.products import projection
from stereovox.simulate.simulation import Simulation
from stereovox.sources.bags.writer import BagWriter

MS = 1_000_000
SETTINGS = {"voxel_size": 0.1, "max_range": 4.0}


def frame(k=0, sensor="front", depth=None):
    T = np.eye(4)
    T[2, 3] = 1.0
    depth = wall(2.0, seed=k) if depth is None else depth
    return Frame(depth, CAMERA, T @ T_BODY_OPTICAL, 10**18 + 33 * MS * k, 0.001, name=f"frame {k}", sensor=sensor)


def test_the_2d_map_is_written_while_it_grows_and_complete_at_the_end(tmp_path):
    mapper = Mapper(**SETTINGS, **{"scan.floor": 0.0})  # its images show none
    grid = GridFile(mapper, tmp_path / "g.yaml", (0.8, 1.2), period_s=0.0)
    for k in range(8):
        grid.after(frame(k), mapper.add(frame(k)))
    grid.finish()
    grid.close()
    assert grid.written >= 2
    found = read_map_server(tmp_path / "g.yaml")
    assert (found.cells == 100).sum() > 5
    assert (found.cells == 0).sum() > 50


def test_nothing_is_written_of_a_map_that_no_second_frame_has_confirmed(tmp_path):
    mapper, said = Mapper(**SETTINGS, clock=lambda: 10**9, **{"scan.floor": 0.0}), []
    grid = GridFile(mapper, tmp_path / "g.yaml", (0.8, 1.2), period_s=0.0, notify=said.append)
    sphere = LiveSphere(mapper.config, {"front": T_BODY_OPTICAL}, mapper=mapper)
    written = []
    for k in range(2):
        report = mapper.add(frame(k))
        for output in (grid, sphere):
            output.after(frame(k), report)
        if grid._busy is not None:
            grid._busy.result()
        written.append(grid.written)
        if not k:
            with pytest.raises(StereovoxError, match=r"waiting: .*no frame has confirmed"):
                sphere.grid()
    grid.close()
    assert (written, said) == ([0, 1], [])
    assert sphere.grid()


@pytest.mark.parametrize("off_m", [0.0, -1.0, 1.0])
def test_what_stands_on_the_true_floor_is_not_free_in_the_written_2d_map(tmp_path, monkeypatch, off_m):
    """The camera begins 1.3 m above the floor, at z = 0. A floor that is 1 m off fails the same test."""
    simulation, find = Simulation("sim:room?image_width=96", frames=80), projection.find_floor

    def wrong(voxel_map):
        floor = find(voxel_map)
        return replace(floor, height=floor.height + np.float32(off_m))

    monkeypatch.setattr(projection, "find_floor", wrong)
    origin = simulation.true_pose(0)[:3, 3].copy()
    mapper = Mapper(voxel_size=0.1)
    grid = GridFile(mapper, tmp_path / "g.yaml", period_s=0.0)
    for k in range(80):
        T = simulation.true_pose(k).copy()
        T[:3, 3] -= origin
        made = replace(simulation.frame(k), T_world_sensor=T)
        grid.after(made, mapper.add(made))
    grid.finish()
    grid.close()
    world = built_in("room?image_width=96", 80)
    found = score(read_map_server(tmp_path / "g.yaml"), truth_of(mapper.map, world, origin))
    assert found.obstacles > 100
    good = found.called_free <= 0.005 * found.obstacles and found.stays_free > 0.1 * found.floor
    assert good == (off_m == 0), found


def test_a_2d_map_that_cannot_be_written_does_not_end_the_run(tmp_path):
    mapper, said = Mapper(**SETTINGS), []
    (tmp_path / "sub").mkdir()
    grid = GridFile(mapper, tmp_path / "sub" / "g.yaml", period_s=0.0, notify=said.append)
    (tmp_path / "sub").rmdir()
    grid.after(frame(), mapper.add(frame()))
    grid.finish()
    grid.close()
    assert any("g.yaml" in line for line in said)
    with pytest.raises(StereovoxError, match="give a name that ends in"):
        GridFile(mapper, tmp_path / "g.jpg")


def test_refused_images_do_not_enter_the_distances_all_round(tmp_path):
    sphere = LiveSphere(Mapper(**SETTINGS).config, {"front": T_BODY_OPTICAL})
    sphere.after(frame(), UpdateReport(refused="no_pose"))
    assert not sphere.known
    with pytest.raises(StereovoxError, match="no image has been mapped yet"):
        sphere.grid()
    sphere.after(frame(), UpdateReport())
    assert sphere.known


def test_a_slow_disk_costs_images_of_the_recording_not_of_the_map(tmp_path, monkeypatch):
    go_on, entered = threading.Event(), threading.Event()
    slow = Recorder._write

    def write(self, one):
        entered.set()
        go_on.wait(30)
        slow(self, one)

    monkeypatch.setattr(Recorder, "_write", write)
    recorder = Recorder(tmp_path / "log.mcap", {"front": T_BODY_OPTICAL})
    recorder.after(frame(), UpdateReport())
    assert entered.wait(30)
    for k in range(1, WAITING + 6):
        recorder.after(frame(k), UpdateReport())
    go_on.set()
    recorder.finish()
    assert recorder.counts == {"images": WAITING + 1, "skipped": 5}
    assert len(open_source(tmp_path / "log.mcap")) == WAITING + 1


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (
            SourceError("log.mcap: cannot be written (No space left on device)"),
            "log.mcap: cannot be written (No space left on device)",
        ),
        (RuntimeError("broken"), "log.mcap: RuntimeError: broken"),
    ],
)
def test_a_full_disk_ends_the_recording_alone(error, why, tmp_path, monkeypatch):
    said = []
    monkeypatch.chdir(tmp_path)

    def full(self, *args, **more):
        raise error

    monkeypatch.setattr("stereovox.sources.bags.writer.BagWriter.depth", full)
    recorder = Recorder("log.mcap", {"front": T_BODY_OPTICAL}, notify=said.append)
    for k in range(3):
        recorder.after(frame(k), UpdateReport())
    recorder.close()
    assert said == [f"{why}; nothing is recorded; mapping continues"]
    assert not list(tmp_path.iterdir())


def test_what_was_recorded_before_the_disk_was_full_is_kept(tmp_path, monkeypatch):
    said, depth = [], BagWriter.depth
    monkeypatch.chdir(tmp_path)

    def filling(self, frame, *args, **more):
        if frame.stamp_ns >= 10**18 + 20 * 33 * MS:
            raise SourceError("log.mcap: cannot be written (No space left on device)")
        depth(self, frame, *args, **more)

    monkeypatch.setattr(BagWriter, "depth", filling)
    recorder = Recorder("log.mcap", {"front": T_BODY_OPTICAL}, notify=said.append)
    camera, noise = PinholeCamera(320, 240, 200.0, 200.0, 159.5, 119.5), np.random.default_rng(0)
    for k in range(21):
        large = frame(k, depth=noise.integers(500, 4000, (240, 320), np.uint16))
        recorder.after(replace(large, camera=camera), UpdateReport())
    recorder.close()
    (left,) = tmp_path.glob("log.mcap.*.unfinished/log/log.mcap")
    assert said == [
        f"log.mcap: cannot be written (No space left on device); the part recorded before is in "
        f"{left.relative_to(tmp_path)}; mapping continues"
    ]
    assert 10 < len(open_source(left)) <= 20  # the last megabyte may be missing


def test_a_disk_that_is_full_at_the_very_end_costs_the_index_alone(tmp_path, monkeypatch):
    said = []
    monkeypatch.chdir(tmp_path)

    def full(self):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("stereovox.sources.bags.writer.BagFileWriter._move", full)
    recorder = Recorder("log.mcap", {"front": T_BODY_OPTICAL}, notify=said.append)
    for k in range(3):
        recorder.after(frame(k), UpdateReport())
    recorder.finish()
    (left,) = tmp_path.glob("log.mcap.*.unfinished/log/log.mcap")
    assert "No space left on device" in said[0]
    assert str(left.relative_to(tmp_path)) in said[0]
    assert len(open_source(left)) == 3


def test_what_is_written_is_flushed_to_the_disk_now_and_then(tmp_path, monkeypatch):
    flushed = threading.Event()

    def note(file):
        if file.suffix == ".mcap":
            flushed.set()

    monkeypatch.setattr("stereovox.live.recorder.SYNC_S", 0.01)
    monkeypatch.setattr("stereovox.sources.bags.writer.sync_file", note)
    recorder = Recorder(tmp_path / "log.mcap", {"front": T_BODY_OPTICAL})
    recorder.after(frame(0), UpdateReport())
    assert flushed.wait(10)
    recorder.close()


KILLED = """
import sys
import numpy as np
from stereovox import Frame, PinholeCamera
from stereovox.sources.bags.writer import BagWriter

camera, noise = PinholeCamera(320, 240, 200.0, 200.0, 159.5, 119.5), np.random.default_rng(0)
with BagWriter(sys.argv[1]) as bag:
    for k in range(40):
        depth = noise.integers(500, 4000, (240, 320), np.uint16)
        bag.depth(Frame(depth, camera, np.eye(4), 10**18 + k * 33_000_000, 0.001))
        bag.transform(10**18 + k * 33_000_000, "map", "camera_depth_optical_frame", np.eye(4))
    print("written", flush=True)
    sys.stdin.read()
"""


def test_a_recording_is_not_lost_by_a_kill(tmp_path):
    file = tmp_path / "log.mcap"
    with Popen([sys.executable, "-c", KILLED, file], stdin=PIPE, stdout=PIPE) as process:
        assert process.stdout.readline() == b"written\n"
        process.kill()
    with pytest.raises(SourceError, match=r"a recording that was cut off: (.*)") as told:
        open_source(file)
    again = open_source(told.value.args[0].rpartition("cut off: ")[2].removesuffix(")"))
    assert 30 < len(again) <= 40
    assert not next(iter(again)).fault


def test_images_without_a_pose_are_recorded_too(tmp_path):
    recorder = Recorder(tmp_path / "log.mcap", {"front": T_BODY_OPTICAL})
    recorder.after(frame(0), UpdateReport())
    lost = Frame(wall(2.0), CAMERA, np.full((4, 4), np.nan), 10**18 + 33 * MS, 0.001, sensor="front", fault="no_pose")
    recorder.after(lost, UpdateReport(refused="no_pose"))
    recorder.after(frame(2, depth=np.empty((0, 0), np.uint16)), UpdateReport(refused="unreadable"))
    recorder.finish()
    assert recorder.counts == {"images": 2, "unsuitable": 1}
    first, second = open_source(tmp_path / "log.mcap")
    assert not first.fault
    assert second.pose_off_ns == 33 * MS  # nobody said where: the reader reports how far it had to guess


def test_pictures_are_recorded_with_their_place(tmp_path):
    def unreadable():
        raise FrameRefused("unreadable", "torn")

    T = np.eye(4)
    T[0, 3] = 0.015
    pictures = [np.full((CAMERA.height, CAMERA.width), 40 + k, np.uint8) for k in range(2)]
    recorder = Recorder(tmp_path / "log.mcap", {"front": T_BODY_OPTICAL})
    for k, pixels in enumerate([pictures[0], lambda: pictures[1], unreadable]):
        recorder.after(replace(frame(k), photo=Photo(pixels, CAMERA, T)), UpdateReport())
    recorder.finish()
    assert recorder.counts == {"images": 3}
    again = list(open_source(tmp_path / "log.mcap"))
    for one, grey in zip(again, pictures, strict=False):
        np.testing.assert_array_equal(one.photo.pixels(), grey)
        np.testing.assert_allclose(one.photo.T_sensor_camera, T, atol=1e-12)


def test_nothing_is_left_of_a_recording_without_images(tmp_path):
    Recorder(tmp_path / "log.mcap", {"front": T_BODY_OPTICAL}).close()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "word"), [("front", "front"), ("realsense:042?imu=off", "realsense_042_imu_off"), ("1", "camera_1")]
)
def test_names_become_topics(name, word):
    assert topic(name) == word
    assert optical(name) == f"{word}_depth_optical_frame"


def test_two_cameras_of_one_topic_are_refused(tmp_path):
    with pytest.raises(StereovoxError, match="share a topic"):
        Recorder(tmp_path / "log.mcap", {"a b": T_BODY_OPTICAL, "a:b": T_BODY_OPTICAL})


def test_latency_counts_images_that_were_mapped_from_their_stamp():
    moments = [Moment("a", epoch_ns() - 10**9, 0)]
    latency = Latency(lambda: moments[0])
    for refused in (None, "no_pose", None):
        latency.mapped.after(None, UpdateReport(refused=refused))
    latency.sent.after(None, UpdateReport())
    found = latency.summary()
    assert 1000 <= found["map"]["median"] < 30_000
    assert found["map"]["max"] <= found["outputs"]["max"]
    assert found["since"] == "stamp"
    assert len(latency._map_ms) == 2
    json.dumps(found)
