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
from made_walks import DEPTH, write_walk

from stereovox.mapper import Mapper
from stereovox.maps import load_map
from stereovox.sources import open_source

PLAYER = Path(__file__).with_name("play.py")
PATIENCE_S = 60


def played(bag: Path, out: Path, env: dict[str, str], rate: str, clock: str, *options: str) -> dict:
    """Play the bag to a node that saves at SIGTERM, of which two come; return what it says."""
    words = ["ros2", "--voxel-size", "0.1", "--out", str(out), "--json", *options]
    command = [sys.executable, "-m", "stereovox", *words]
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as node:
        try:
            player = [sys.executable, str(PLAYER), str(bag), rate, clock, DEPTH]
            subprocess.run(player, env=env, check=True, timeout=PATIENCE_S)
        finally:
            node.send_signal(signal.SIGTERM)
            node.send_signal(signal.SIGTERM)
        stdout, stderr = node.communicate(timeout=PATIENCE_S)
    assert node.returncode == 0, stderr
    return json.loads(stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A bag, and the map that it gives."""
    bag = write_walk(tmp_path_factory.mktemp("walk") / "walk.mcap")
    mapper = Mapper("default", voxel_size=0.1)
    for frame in open_source(str(bag)):
        assert mapper.add(frame).refused is None
    return bag, mapper.map


@pytest.mark.parametrize("clock", ["no", "clock"])
def test_the_map_of_the_replay_is_the_map_of_the_bag(walk, tmp_path, alone, clock):
    bag, expected = walk
    parameters = ["-p", "ros.late_s:=10.0", "-p", f"use_sim_time:={str(clock == 'clock').lower()}"]
    told = played(
        bag, tmp_path / "live.svox", alone, "2", clock, "--depth", DEPTH, "--ros-args", *parameters
    )  # fmt: skip
    assert (told["frames"], told["refused"], told["dropped"]) == (12, {}, {})
    assert told["received"] == {DEPTH: 12}
    live = load_map(tmp_path / "live.svox")
    for mine, theirs in zip(live.blocks(), expected.blocks(), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    np.testing.assert_array_equal(live.viewpoint.T_world_camera, expected.viewpoint.T_world_camera)
