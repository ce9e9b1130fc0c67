# SPDX-License-Identifier: Apache-2.0
"""The node as a managed one, in a process of its own: when it has topics, when it maps, and that the map is saved."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from types import SimpleNamespace

import numpy as np
import pytest
import wire
from made_walks import CAMERA, DEPTH, OPTICAL, base_at, depth_at

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState, GetState  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from sensor_msgs.msg import CameraInfo, Image  # noqa: E402

from stereovox.maps import load_map  # noqa: E402
from stereovox.ros.lifecycle import Managed  # noqa: E402

INFO = "/camera/depth/camera_info"
PATIENCE_S = 120


class Other:
    """A node in this process that sends frames and asks for transitions."""

    def __init__(self):
        rclpy.init(args=[])
        self.node, self._executor = rclpy.create_node("other"), SingleThreadedExecutor()
        self._executor.add_node(self.node)
        kinds = {DEPTH: Image, INFO: CameraInfo, "/odom": Odometry}
        self.in_map = 0
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._told, 10)
        self.send = {topic: self.node.create_publisher(kind, topic, 20) for topic, kind in kinds.items()}

    def _told(self, message):
        values = {pair.key: pair.value for pair in message.status[0].values}
        self.in_map = int(values.get("frames_in_map", 0))

    def until(self, holds):
        end = time.monotonic() + PATIENCE_S
        while not holds():
            assert time.monotonic() < end, "nothing came"
            self._executor.spin_once(timeout_sec=0.05)

    def call(self, kind, name, request):
        client = self.node.create_client(kind, f"/stereovox/{name}")
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def change(self, transition: int) -> bool:
        return self.call(ChangeState, "change_state", ChangeState.Request(transition=Transition(id=transition))).success

    def state(self) -> str:
        return self.call(GetState, "get_state", GetState.Request()).current_state.label

    def heard(self) -> bool:
        return all(one.get_subscription_count() for one in self.send.values())

    def drive(self, frames: Iterable[int]):
        """Send frames, and listen meanwhile."""
        made = wire.messages()
        for k in frames:
            frame = depth_at(k)
            T = base_at(frame.stamp_ns)
            pose = np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
            self.publish("/odom", made.odometry(pose, frame.stamp_ns, "odom", "base_link"))
            self.publish(INFO, made.camera_info(CAMERA, frame.stamp_ns, OPTICAL))
            self.publish(DEPTH, made.image(frame.depth, frame.stamp_ns, OPTICAL))
            self._executor.spin_once(timeout_sec=0.05)

    def publish(self, topic, message):
        self.send[topic].publish(wire.packed(message))

    def close(self):
        self.node.destroy_node()
        rclpy.shutdown()


@pytest.fixture
def pair(tmp_path, alone, monkeypatch):
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID"):
        monkeypatch.setenv(name, alone[name])
    out = tmp_path / "live.svox"
    mount = f"base_link {OPTICAL} 0.1 0 0.4 -1.5708 0 -1.5708"
    words = ["ros2", "--lifecycle", "--depth", DEPTH, "--odometry", "/odom", "--fixed", mount, "--voxel-size", "0.1"]
    command = [sys.executable, "-m", "stereovox", *words, "--out", str(out), "--json"]
    with subprocess.Popen(command, env=alone, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        other = Other()
        yield process, other, out
        other.close()
        process.kill()


def test_it_has_topics_when_configured_maps_when_active_and_saves_at_cleanup(pair):
    process, other, out = pair
    assert other.state() == "unconfigured"
    assert not other.heard()
    assert other.change(Transition.TRANSITION_CONFIGURE)
    other.until(other.heard)
    assert other.state() == "inactive"
    other.drive(range(2))  # nobody maps them
    assert other.change(Transition.TRANSITION_ACTIVATE)
    first = iter(range(2, 200))
    while not other.in_map:  # images are sent best effort
        other.drive([next(first)])
    assert other.change(Transition.TRANSITION_DEACTIVATE)
    other.drive(range(200, 203))
    assert other.change(Transition.TRANSITION_CLEANUP)
    other.until(lambda: not other.heard() and out.exists())
    assert other.in_map <= load_map(out).frames < next(first) - 1
    assert other.change(Transition.TRANSITION_CONFIGURE)  # again, from nothing
    other.until(other.heard)
    assert other.change(Transition.TRANSITION_ACTIVATE)
    other.in_map = 0
    again = iter(range(200))
    while not other.in_map:
        other.drive([next(again)])
    process.send_signal(signal.SIGTERM)
    stdout, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, stderr
    assert json.loads(stdout.splitlines()[-1])["frames"] <= next(again)


def test_a_run_whose_cleanup_waits_is_not_replaced_but_ends(alone, monkeypatch):
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID"):
        monkeypatch.setenv(name, alone[name])
    made, ended, asked = [], [], []

    class Run:
        def __init__(self, _):
            self.map_node = SimpleNamespace(active=True)
            made.append(self)

        def step(self):  # both calls come while messages are received
            managed.cleanup()
            asked.append(managed.configure())

        def end(self):
            ended.append(self)
            return {}

    rclpy.init(args=[])
    try:
        node = rclpy.create_node("managed")
        managed = Managed(node, Run)
        assert managed.configure()
        managed._take(None)
        assert asked == [False]
        assert ended == made
        assert managed.configure()
        assert len(made) == 2
        node.destroy_node()
    finally:
        rclpy.shutdown()


def test_a_configuration_that_cannot_be_fails_and_the_node_stays(pair):
    process, other, out = pair
    out.mkdir()
    (out / "not a map").touch()
    assert not other.change(Transition.TRANSITION_CONFIGURE)
    assert other.state() == "unconfigured"
    assert not other.heard()
    (out / "not a map").unlink()
    out.rmdir()
    assert other.change(Transition.TRANSITION_CONFIGURE)
    assert other.change(Transition.TRANSITION_INACTIVE_SHUTDOWN)
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, stderr
    assert "not configured: " in stderr
