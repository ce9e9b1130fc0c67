# SPDX-License-Identifier: Apache-2.0
"""Plays a bag on ROS 2 topics, as `ros2 bag play` does: python play.py BAG RATE [clock].

Waits until somebody listens to all that is known to be of use, and in the end until all of it was received.
"""

from __future__ import annotations

import sys
import time
from importlib import import_module
from pathlib import Path

import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile

from stereovox.sources.bag_files import open_bag

PATIENCE_S = 20.0
LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def kind_of(name: str) -> type:
    package, _, message = name.partition("/")
    return getattr(import_module(f"{package}.msg"), message)


def main(path: str, rate: float, clock: bool) -> None:
    file = open_bag(Path(path))
    rclpy.init(args=[])
    node = rclpy.create_node("player")
    publishers = {
        topic: node.create_publisher(kind_of(kind), topic, LATCHED if topic == "/tf_static" else 100)
        for topic, kind in file.types.items()
    }
    ticks = node.create_publisher(kind_of("rosgraph_msgs/Clock"), "/clock", 10) if clock else None
    wanted = [one for topic, one in publishers.items() if topic in ("/tf", *sys.argv[4:])]
    until = time.monotonic() + PATIENCE_S
    while not all(one.get_subscription_count() for one in wanted):
        if time.monotonic() > until:
            sys.exit("nobody listens")
        time.sleep(0.02)
    time.sleep(0.3)  # both sides know of each other now
    messages = sorted((int(stamp), topic, i) for topic in publishers for i, stamp in enumerate(file.stamps(topic)))
    begin = time.monotonic()
    for stamp_ns, topic, i in messages:
        time.sleep(max(0.0, begin + 1e-9 * (stamp_ns - messages[0][0]) / rate - time.monotonic()))
        if ticks is not None:
            ticks.publish(kind_of("rosgraph_msgs/Clock")(clock=rclpy.time.Time(nanoseconds=stamp_ns).to_msg()))
        publishers[topic].publish(bytes(file.read(topic, i).block(0).obj))
    time.sleep(0.5)
    rclpy.shutdown()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), sys.argv[3] == "clock")
