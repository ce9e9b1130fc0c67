# SPDX-License-Identifier: Apache-2.0
"""A recording with an IMU is tracked and mapped with it by itself, and says so; without one nothing changes."""

import json
from dataclasses import replace

import numpy as np
from made_unposed import room
from naive_imu import felt_along

import stereovox as sv
from stereovox.cli import main
from stereovox.geometry.se3 import rotation_matrix
from stereovox.opening import open_images
from stereovox.sources.bags.writer import BagWriter
from stereovox.sources.calibration.camera_file import with_camera
from stereovox.sources.paced import Turned, TurnedRecording

COUNT = 20
ASLANT = np.eye(4)
ASLANT[:3, :3] = rotation_matrix([0.3, -0.2, 0.0])
"""The room leans by 20 degrees: a floor in view says something else of up than the accelerometer."""
OPTICAL = "camera_imu_optical_frame"


def recorded(path, *, wrong=None, force=1.0, frame_id=OPTICAL):
    """Frames of a room and an IMU at rest for 1 s before; wrong: (3, 3) axes of the rates."""
    frames = [replace(frame, stamp_ns=10**10 + frame.stamp_ns) for frame in room(COUNT)]
    poses = [ASLANT @ frame.T_world_sensor for frame in frames]
    stamps, rates, forces = felt_along([frame.stamp_ns for frame in frames], poses, before_s=1.0)
    with BagWriter(path) as bag:
        for frame in frames:
            bag.depth(frame)
        for stamp, rate, felt in zip(stamps.tolist(), rates, force * forces, strict=True):
            bag.imu(stamp, rate if wrong is None else wrong @ rate, felt, frame_id=frame_id)
    return path


def off_up(found):
    """Degrees between the up direction of the first frame and the true one."""
    true = (ASLANT @ room(COUNT)[0].T_world_sensor)[2, :3]
    return float(np.degrees(np.arccos(true @ found.T_world_sensor[0][2, :3])))


def test_a_bag_is_tracked_with_its_imu_and_says_so(tmp_path):
    said = []
    found = sv.track_recording(recorded(tmp_path / "walk.bag"), notify=said.append)
    assert found.tracked.all()
    assert [line for line in said if "the IMU helps: turns and which way is up (walk.bag /imu, 200 readings" in line]
    assert found.imu.startswith("walk.bag /imu: turns of ")
    assert f"note: {found.imu}" in said
    assert found.summary()["imu"] == found.imu
    assert off_up(found) < 1


def test_without_the_imu_it_is_as_before(tmp_path):
    said = []
    found = sv.track_recording(f"{recorded(tmp_path / 'walk.bag')}?imu=off", notify=said.append)
    assert found.tracked.all()
    assert found.imu == ""
    assert off_up(found) > 15
    assert not any("IMU" in line for line in said)
    assert "imu" not in found.summary()


def test_a_map_is_made_with_it_too(tmp_path, capsys):
    where = recorded(tmp_path / "walk.mcap")
    assert main(["map", str(where), "--out", str(tmp_path / "m.svox"), "--json"]) == 0
    out = capsys.readouterr()
    assert "note: the IMU helps" in out.err
    assert "turns of" in json.loads(out.out.splitlines()[-1])["imu"]
    assert out.err.count("turns of") == 1


def test_a_wrong_mount_is_told_and_the_recording_tracked_all_the_same(tmp_path):
    said = []
    where = recorded(tmp_path / "walk.bag", wrong=np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]))
    found = sv.track_recording(where, notify=said.append)
    assert found.tracked.all()
    assert "left out: its turns differ from those of the images" in found.imu
    assert "add imu=off" in said[-1]


def test_one_that_cannot_be_used_is_told_and_left(tmp_path):
    said = []
    found = sv.track_recording(recorded(tmp_path / "walk.bag", frame_id="imu_link"), notify=said.append)
    assert found.tracked.all()
    assert any(line.startswith("note: the IMU is not used: ") and "record /tf_static" in line for line in said)


def test_forces_in_g_say_nothing_of_up(tmp_path):
    found = sv.track_recording(recorded(tmp_path / "walk.bag", force=1 / 9.81))
    assert found.imu.endswith("its accelerometer did not show which way is up")
    assert "turns of" in found.imu


def test_streams_that_change_frames_keep_the_imu(tmp_path):
    source = open_images(recorded(tmp_path / "walk.bag"))
    camera = tmp_path / "camera.toml"
    camera.write_text("width = 160\nheight = 120\nfx = 130.0\nfy = 130.0\ncx = 79.5\ncy = 59.5\n")
    changed = (
        with_camera(source, str(camera)), Turned(source, np.eye(4)), TurnedRecording(source, np.eye(4)), source.after(2)
    )  # fmt: skip
    for one in changed:
        assert len(one.imu()) == len(source.imu())


def test_corrected_poses_do_without_it(tmp_path):
    source = open_images(recorded(tmp_path / "walk.bag"))
    result = sv.map_recording(source, tmp_path / "m.svox", poses="both")
    assert result.imu == ""
