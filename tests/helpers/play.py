# SPDX-License-Identifier: Apache-2.0
"""Plays a bag on ROS 2 topics, as `ros2 bag play` does: python play.py BAG RATE clock|no TOPIC...

Waits until a node listens, and in the end until it has taken in all of TOPIC...: its diagnostics say so.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from stereovox.ros.poses.tf_message import tf_message
from stereovox.sources.bags import open_bag

PATIENCE_S = 60.0
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def kind_of(name: str) -> type:
    if name == "tf2_msgs/TFMessage":
        return tf_message()
    package, _, message = name.partition("/")
    return getattr(import_module(f"{package}.msg"), message)


def wait(node: Node, holds: Callable[[], object], said: str) -> None:
    until = time.monotonic() + PATIENCE_S
    while not holds():
        if time.monotonic() > until:
            sys.exit(said)
        rclpy.spin_once(node, timeout_sec=0.05)


def main(path: str, rate: float, clock: bool, mapped: list[str]) -> None:
    file = open_bag(Path(path))
    rclpy.init(args=[])
    node = rclpy.create_node("player")
    publishers = {
        topic: node.create_publisher(kind_of(kind), topic, LATCHED if topic == "/tf_static" else 100)
        for topic, kind in file.types.items()
    }
    ticks = node.create_publisher(kind_of("rosgraph_msgs/Clock"), "/clock", 10) if clock else None
    wanted = [
        publishers[topic] for topic in ("/tf" if "/tf" in publishers else "/odom", *mapped) if topic in publishers
    ]
    told: dict[str, str] = {}

    def take(message: DiagnosticArray) -> None:
        told.update((pair.key, pair.value) for pair in message.status[0].values)

    node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
    wait(node, lambda: told and all(one.get_subscription_count() for one in wanted), "nobody listens")
    time.sleep(0.3)  # both sides know of each other now
    messages = sorted((int(stamp), topic, i) for topic in publishers for i, stamp in enumerate(file.stamps(topic)))
    begin = time.monotonic()
    for stamp_ns, topic, i in messages:
        time.sleep(max(0.0, begin + 1e-9 * (stamp_ns - messages[0][0]) / rate - time.monotonic()))
        if ticks is not None:
            ticks.publish(kind_of("rosgraph_msgs/Clock")(clock=rclpy.time.Time(nanoseconds=stamp_ns).to_msg()))
        publishers[topic].publish(bytes(file.read(topic, i).block(0).obj))
    count = str(sum(len(file.stamps(topic)) for topic in mapped))
    wait(node, lambda: (told["received"], told["waiting"]) == (count, "0"), "not all was taken in")
    rclpy.shutdown()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), sys.argv[3] == "clock", sys.argv[4:])
