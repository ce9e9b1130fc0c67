# SPDX-License-Identifier: Apache-2.0
"""A bag that is played to the node gives the map that the bag gives by itself: two processes on loopback."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from made_walks import DEPTH, write_room, write_walk

from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap, load_map
from stereovox.opening import open_source
from stereovox.ros.poses.tf_message import tf_message
from stereovox.runs.trajectory import track_recording
from stereovox.simulate.simulation import Simulation

PLAYER = Path(__file__).parents[1] / "helpers/play.py"
PATIENCE_S = 150
PATIENT = [word for name in ("late_s:=30.0", "wait_s:=30.0", "queue:=100") for word in ("-p", f"ros.{name}")]
"""A busy machine drops nothing."""


def played(bag: Path, out: Path, env: dict[str, str], clock: str, *options: str) -> dict:
    """Play the bag to a node that saves at SIGTERM, which arrives twice; return its output."""
    words = ["ros2", "--voxel-size", "0.1", "--out", str(out), "--depth", DEPTH, "--json", *options]
    command = [sys.executable, "-m", "stereovox", *words]
    player = [sys.executable, str(PLAYER), str(bag), "2", clock, DEPTH]
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as node:
        try:
            play = subprocess.run(player, env=env, capture_output=True, text=True, timeout=PATIENCE_S)
            node.send_signal(signal.SIGTERM)
            node.send_signal(signal.SIGTERM)
            stdout, stderr = node.communicate(timeout=PATIENCE_S)
        finally:
            node.kill()
    assert (play.returncode, node.returncode) == (0, 0), play.stderr + stderr
    return json.loads(stdout.splitlines()[-1])


def mapped(recording: str) -> VoxelMap:
    mapper = Mapper("default", voxel_size=0.1)
    for frame in open_source(recording):
        assert mapper.add(frame).refused is None
    return mapper.map


def check_same(told: dict, live: VoxelMap, expected: VoxelMap) -> None:
    assert (told["frames"], told["refused"], told["dropped"]) == (12, {}, {})
    assert told["received"] == {DEPTH: 12}
    for mine, theirs in zip(live.storage.blocks(), expected.storage.blocks(), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    np.testing.assert_array_equal(live.viewpoint.T_world_camera, expected.viewpoint.T_world_camera)


@pytest.mark.parametrize("clock", ["no", "clock"])
def test_the_map_of_the_replay_is_the_map_of_the_bag(tmp_path, alone, clock):
    pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")
    if tf_message() is None:
        pytest.skip("neither tf2_msgs nor the wheels of the extra ros2 are installed")
    bag = write_walk(tmp_path / "walk.mcap")
    told = played(
        bag, tmp_path / "live.svox", alone, clock, "--ros-args", *PATIENT,
        "-p", f"use_sim_time:={str(clock == 'clock').lower()}",
    )  # fmt: skip
    check_same(told, load_map(tmp_path / "live.svox"), mapped(str(bag)))


def test_the_map_of_a_replay_with_odometry_is_the_map_of_the_bag(tmp_path, alone):
    """Needs no message that is not on PyPI."""
    bag = write_walk(tmp_path / "walk.mcap", odometry=True)
    told = played(bag, tmp_path / "live.svox", alone, "no", "--odometry", "/odom", "--ros-args", *PATIENT)
    check_same(told, load_map(tmp_path / "live.svox"), mapped(f"{bag}?poses=/odom"))


def test_a_bag_without_poses_is_tracked_as_by_itself(tmp_path, alone):
    """All but the first image, which the node cannot hold back."""
    source = Simulation("sim:room?camera=kinect&image_width=160")
    bag = write_room(tmp_path / "room.mcap", [source.frame(i) for i in range(0, 16, 2)])
    words = ["--poses", "track", "--max-range", "5", "--ros-args", *PATIENT]
    told = played(bag, tmp_path / "live.svox", alone, "no", *words)
    assert (told["frames"], told["refused"], told["dropped"]) == (7, {"tracking_lost": 1}, {})
    expected = track_recording(str(bag), max_range=5.0, voxel_size=0.1)
    live = load_map(tmp_path / "live.svox")
    np.testing.assert_allclose(live.path, expected.T_world_sensor[1:, :3, 3], atol=1e-5)
