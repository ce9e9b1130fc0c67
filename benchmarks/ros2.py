# SPDX-License-Identifier: Apache-2.0
"""How long after a depth image does the node publish the map, and does it lose any?

    python benchmarks/ros2.py [--seconds 30] [--hz 30] [--listen cells] [--json] [-- OPTIONS of stereovox ros2]

Two processes on loopback: this one sends simulated 848x480 images (16UC1), camera_info and, at 100 Hz, /tf, stamped
with the clock on the wall, and listens to the 2-D map; the other is the node. Latency: from an image's stamp to the
arrival of a map with that stamp here, including sending, waiting for the pose, mapping, publishing and receiving.
`cpu`: CPU time of the node's process, as a share of one core and in milliseconds a frame; other work on the machine
disturbs it less than the latency. --listen cells: also receive the cloud and the OctoMap, once a second; nav2: the
obstacles and the free rays, ten times a second.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rclpy
from nav_msgs.msg import OccupancyGrid
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

import stereovox as sv
from stereovox.ros.outputs import header
from stereovox.ros.poses.tf_message import packed_transforms, tf_message
from stereovox.sources.bags.messages import Wire

KEPT = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
TF_HZ, FRAMES = 100, 90
SOURCE = "sim:room"
PROFILE = Path(__file__).resolve().parents[1] / "examples/ros2/large_images.xml"
"""For both processes; FASTDDS_DEFAULT_PROFILES_FILE="" measures without it."""
WARM_S = 3.0
"""Seconds at the start that do not count, while processes find each other."""
PERCENTILES = (50, 90, 99, 100)


def images(where: str) -> tuple[list[tuple[Image, np.ndarray]], CameraInfo]:
    """Messages of a piece of the flight, back and forth, T_world_camera of each, and their camera."""
    source = sv.open_source(where)
    found = []
    for i in range(FRAMES):
        frame = source.frame(i)
        data = array("B", frame.depth.astype("<u2").tobytes())
        height, width = frame.depth.shape
        image = Image(height=height, width=width, encoding="16UC1", step=2 * width, data=data)
        found.append((image, frame.T_world_sensor))
    camera = source.camera
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    info = CameraInfo(width=camera.width, height=camera.height, k=np.array(K))
    return [*found, *found[-2:0:-1]], info


def transform(T: np.ndarray, stamp_ns: int) -> bytes:
    return packed_transforms(stamp_ns, [("map", "camera", T)])


class Sender:
    """Sends images and transforms at their times, each with its own pose."""

    def __init__(self, node: Any, hz: float, where: str = SOURCE):
        self._frames, self._info = images(where)
        self._hz = hz
        self._image = node.create_publisher(Image, "/camera/image", SENSOR)
        self._infos = node.create_publisher(CameraInfo, "/camera/camera_info", SENSOR)
        self._tf = node.create_publisher(tf_message(), "/tf", 100)
        self.sent: list[int] = []
        self._k = 0

    def run(self, seconds: float) -> None:
        """Send for `seconds`. A transform between two images has the pose of the last one."""
        begin, k, t = time.monotonic(), 0, 0
        while time.monotonic() < begin + seconds:
            due = begin + min(k / self._hz, t / TF_HZ)
            time.sleep(max(0.0, due - time.monotonic()))
            now = time.time_ns()
            if k / self._hz <= t / TF_HZ:
                message, T = self._frames[self._k % len(self._frames)]
                message.header = self._info.header = header(now, "camera")
                self._tf.publish(transform(T, now))
                self._image.publish(message)
                self._infos.publish(self._info)
                self.sent.append(now)
                k, self._k = k + 1, self._k + 1
            else:
                self._tf.publish(transform(self._frames[max(self._k - 1, 0) % len(self._frames)][1], now))
                t += 1


class Listener:
    """Records stamps and arrival times of maps."""

    def __init__(self, node: Any, listen: str):
        self.came: dict[int, int] = {}
        node.create_subscription(OccupancyGrid, "/map_mapping", self._take, KEPT, raw=True)
        if listen == "nav2":
            for topic in ("/obstacles", "/free_rays"):
                node.create_subscription(PointCloud2, topic, lambda data: None, 1, raw=True)
        if listen == "cells":
            from octomap_msgs.msg import Octomap

            node.create_subscription(PointCloud2, "/occupied_cells", lambda data: None, KEPT, raw=True)
            node.create_subscription(Octomap, "/octomap_binary", lambda data: None, KEPT, raw=True)

    def _take(self, data: bytes) -> None:
        self.came.setdefault(Wire(data, cdr=True).header()[0], time.time_ns())


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Run both processes and return the figures."""
    rclpy.init(args=[])
    node = rclpy.create_node("benchmark")
    sender, listener = Sender(node, arguments.hz, arguments.source), Listener(node, arguments.listen)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    options = arguments.options or ["--set", "voxel_size=0.05"]
    command = [sys.executable, "-m", "stereovox", "ros2", "--json", "--depth", "/camera/image", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        while not node.count_subscribers("/camera/image"):
            time.sleep(0.05)
        time.sleep(1.0)  # both sides have found each other
        other = psutil.Process(process.pid)
        sender.run(WARM_S)
        warm, cpu, began = len(sender.sent), sum(other.cpu_times()[:2]), time.monotonic()
        sender.run(arguments.seconds)
        share = (sum(other.cpu_times()[:2]) - cpu) / (time.monotonic() - began)
        time.sleep(1.0)
        process.terminate()
        told = json.loads(process.communicate()[0].splitlines()[-1])
    stamps = sender.sent[warm:]
    late = np.array([listener.came[stamp] - stamp for stamp in stamps if stamp in listener.came]) / 1e6
    return {
        "images": len(stamps),
        "maps": len(late),
        "lost_on_the_way": len(sender.sent) - told["received"]["/camera/image"],
        "dropped": sum(told["dropped"].values()),
        "refused": told["refused"],
        "latency_ms": {f"p{p}": round(float(np.percentile(late, p)), 1) for p in PERCENTILES},
        "frame_ms": told["frame_ms"],
        "cpu_share": round(share, 3),
        "cpu_ms_a_frame": round(1e3 * share / arguments.hz, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--hz", type=float, default=30.0)
    parser.add_argument("--listen", choices=("map", "cells", "nav2"), default="map")
    parser.add_argument("--source", default=SOURCE, help="simulation whose images are sent")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("options", nargs="*", help="of stereovox ros2, behind --")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("FASTDDS_DEFAULT_PROFILES_FILE", str(PROFILE))
    found = measure(parser.parse_args())
    if "--json" in sys.argv:
        print(json.dumps(found))
    else:
        print("\n".join(f"{name:16} {value}" for name, value in found.items()))


if __name__ == "__main__":
    main()
