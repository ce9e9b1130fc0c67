# SPDX-License-Identifier: Apache-2.0
"""The chain of IST 2019 online: a bag is played to the node, all topics come out, and the map is that of the bag."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from made_chain import DEPTH, SCAN, write_drive

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")

from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped  # noqa: E402
from nav_msgs.msg import OccupancyGrid  # noqa: E402
from nav_msgs.srv import GetMap  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from std_msgs.msg import Float32  # noqa: E402

from stereovox.evaluate.grid_scores import score_grids  # noqa: E402
from stereovox.formats.map_server import read_map_server  # noqa: E402
from stereovox.ros.poses.tf_message import tf_message  # noqa: E402
from stereovox.runs.floor import map_floor  # noqa: E402
from stereovox.sources.bags.messages import Wire  # noqa: E402
from stereovox.sources.bags.robot_messages import read_transforms  # noqa: E402

pytest.importorskip("gtsam", reason="gtsam is not installed: pip install 'stereovox[slam]'")
PLAYER = Path(__file__).parents[1] / "helpers/play.py"
PATIENCE_S = 120
PATIENT = [word for name in ("late_s:=30.0", "wait_s:=30.0", "queue:=200") for word in ("-p", f"ros.{name}")]
KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Chain:
    """A node in a process of its own, and this process, which listens."""

    def __init__(self, env, *options: str):
        command = [sys.executable, "-m", "stereovox", "ros2", "--profile", "ist2019", "--json", *options]
        self._env = env
        self._process = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        rclpy.init(args=[])
        self.node, self._executor = rclpy.create_node("listener"), SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.came: dict[str, list] = {}

    def listen(self, kind, topic, qos=10, raw=False):
        self.came[topic] = []
        self.node.create_subscription(kind, topic, self.came[topic].append, qos, raw=raw)

    def until(self, holds):
        end = time.monotonic() + PATIENCE_S
        while not holds():
            assert time.monotonic() < end, "nothing came"
            assert self._process.poll() is None, self._process.communicate()
            self._executor.spin_once(timeout_sec=0.05)

    def play(self, bag, rate, *topics):
        command = [sys.executable, str(PLAYER), str(bag), str(rate), "no", *topics]
        with subprocess.Popen(command, env=self._env, stderr=subprocess.PIPE, text=True) as player:
            self.until(lambda: player.poll() is not None)
            assert player.returncode == 0, player.stderr.read()

    def call(self, kind, name):
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(kind.Request())
        self.until(future.done)
        return future.result()

    def end(self) -> dict:
        self._process.send_signal(signal.SIGTERM)
        stdout, stderr = self._process.communicate(timeout=PATIENCE_S)
        assert self._process.returncode == 0, stderr
        return json.loads(stdout.splitlines()[-1])

    def close(self):
        self._process.kill()
        self._process.communicate()
        self.node.destroy_node()
        rclpy.shutdown()


@pytest.fixture
def chain(alone, monkeypatch):
    """Start a node with these options; it is ended after the test."""
    if tf_message() is None:
        pytest.skip("neither tf2_msgs nor the wheels of the extra ros2 are installed")
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID"):
        monkeypatch.setenv(name, alone[name])
    started = []

    def start(*options: str) -> Chain:
        started.append(Chain(alone, *options, "--ros-args", *PATIENT))
        return started[-1]

    yield start
    for one in started:
        one.close()


def cells(message) -> np.ndarray:
    return np.array(message.data, np.int8).reshape(message.info.height, message.info.width)


def test_the_robot_is_localised_and_maps_as_offline_with_all_topics_out(tmp_path, chain):
    bag, reference = write_drive(tmp_path)
    offline, online = tmp_path / "offline.yaml", tmp_path / "online.yaml"
    map_floor(bag, offline, profile="ist2019", poses=reference, use="depth", start=(0.0, 0.0, 0.0))
    expected = score_grids(read_map_server(offline), read_map_server(reference), align=False).eq7_percent
    one = chain("--poses", str(reference), "--lidar", SCAN, "--start", "0,0,0", "--depth", DEPTH, "--out", str(online))
    one.listen(OccupancyGrid, "/map", KEPT)
    one.listen(OccupancyGrid, "/map_mapping", KEPT)
    one.listen(PoseWithCovarianceStamped, "/amcl_pose", KEPT)
    one.listen(PoseArray, "/particlecloud")
    one.listen(Float32, "/map_error")
    one.listen(tf_message(), "/tf", raw=True)
    one.until(lambda: one.came["/map"])
    one.play(bag, 4.0, SCAN, DEPTH)
    one.until(lambda: all(one.came.values()))
    served, told = one.call(GetMap, "/map_server/map").map, one.end()
    floor = read_map_server(reference)
    np.testing.assert_array_equal(cells(served), floor.cells)
    np.testing.assert_array_equal(cells(one.came["/map"][-1]), floor.cells)
    assert (served.header.frame_id, served.info.origin.position.x) == ("map", pytest.approx(floor.origin[0]))
    assert {message.header.frame_id for message in one.came["/amcl_pose"]} == {"map"}
    assert 1.0 < np.hypot(*place(one.came["/amcl_pose"][-1])) < 10.0  # it has driven
    assert 0 < one.came["/amcl_pose"][-1].pose.covariance[0] < 0.1
    assert len(one.came["/particlecloud"][-1].poses) >= 500
    sent = [tf for data in one.came["/tf"] for tf in read_transforms(Wire(data, cdr=True)) if tf.child == "odom"]
    assert {tf.parent for tf in sent} == {"map"}
    assert told["localisation"] == {"scans": 80, "refused": {}}
    assert 0 < one.came["/map_error"][-1].data < 100
    assert abs(told["error"]["eq7_percent"] - expected) < 1.0
    assert told["frames"] == len(range(64)) - sum(told["refused"].values())
    assert set(told["refused"]) <= {"no_valid_depth", "not_localised", "no_pose"}


def place(message) -> tuple[float, float]:
    return message.pose.pose.position.x, message.pose.pose.position.y


def test_slam_makes_the_map_live_as_offline(tmp_path, chain):
    bag, reference = write_drive(tmp_path)
    live = tmp_path / "live.yaml"
    one = chain("--poses", "slam", "--lidar", SCAN, "--slam-out", str(live))
    one.listen(OccupancyGrid, "/map", KEPT)
    one.listen(tf_message(), "/tf", raw=True)
    one.play(bag, 4.0, SCAN)
    one.until(lambda: len(one.came["/map"]) > 1)
    told = one.end()
    sizes = [int((cells(message) >= 0).sum()) for message in one.came["/map"]]
    assert sizes[-1] > 1.2 * sizes[0]  # it grows
    sent = [tf for data in one.came["/tf"] for tf in read_transforms(Wire(data, cdr=True)) if tf.child == "odom"]
    assert len(sent) > 50
    assert (told["localisation"]["scans"], told["slam"]["doubts"]) == (80, [])
    np.testing.assert_array_equal(read_map_server(live).cells, read_map_server(reference).cells)
