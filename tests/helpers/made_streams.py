# SPDX-License-Identifier: Apache-2.0
"""Streams of a robot that walks through a room, handed to the real node as if time passed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import wire

from stereovox.config import load_config
from stereovox.depth.sphere import T_BODY_OPTICAL
from stereovox.frame import Frame
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_source
from stereovox.ros.poses.clocks import SensorClocks
from stereovox.sources.poses.poses import Poses

MS, S = 1_000_000, 1_000_000_000
START = 1_700_000_000 * S
POSE_NS = 10 * MS


@cache
def walk(count: int) -> list[Frame]:
    """Images at 30 Hz with exact poses."""
    return [frame for _, frame in zip(range(count), open_source("sim:room?image_width=320"), strict=False)]


@dataclass
class Told:
    """What the node made of images. wrong_m, stamps_s: of each that was mapped: how far its pose is from the true one,
    and when it was taken. refused: reasons. lines: what was reported to the user, and when."""

    wrong_m: dict[str, list[float]] = field(default_factory=dict)
    taken_s: dict[str, list[float]] = field(default_factory=dict)
    refused: dict[str, Counter[str]] = field(default_factory=dict)
    lines: list[tuple[float, str]] = field(default_factory=list)


def stream(monkeypatch, topics: dict[str, Callable[[float], float]], pose_step: Callable[[float], float],
           count: int = 75, background: bool = False, late_s: float = 0.02) -> Told:  # fmt: skip
    """Play a walk to a node.

    topics: of cameras, each with seconds that its stamps are ahead at a time. pose_step: those of /tf.
    """
    import rclpy

    from stereovox.ros import node as node_module
    from stereovox.ros import subscriptions
    from stereovox.ros.mapping import Mapping
    from stereovox.ros.node import MapNode
    from stereovox.ros.options import Options, freeze
    from stereovox.ros.poses.tf_message import tf_message

    told, now, frames = Told(), [0], walk(count)
    monkeypatch.setattr(subscriptions, "arrived", lambda info: now[0])
    monkeypatch.setattr(node_module, "monotonic_ns", lambda: now[0])
    monkeypatch.setattr(node_module, "IDLE_S", 0.001)
    monkeypatch.setattr(node_module, "SOON_S", 0.001)
    which = {frame.depth.tobytes(): frame for frame in frames}
    mapping = Mapping(load_config("default", voxel_size=0.1))
    add = mapping.add

    def noted(frame):
        report = add(frame)
        if report.refused:
            told.refused.setdefault(frame.sensor, Counter())[report.refused] += 1
        else:
            true = which[frame.depth.tobytes()]
            wrong = float(np.linalg.norm((frame.T_world_sensor - true.T_world_sensor)[:3, 3]))
            told.wrong_m.setdefault(frame.sensor, []).append(wrong)
            told.taken_s.setdefault(frame.sensor, []).append((true.stamp_ns - frames[0].stamp_ns) / S)
        return report

    mapping.add = noted
    node, other = rclpy.create_node("stereovox"), rclpy.create_node("robot")
    freeze(node, "")
    maker = MapNode(node, mapping, Options(depth=tuple(topics), out=""), lambda: "")
    began_ns = START + frames[0].stamp_ns
    maker._clocks = SensorClocks(
        mapping.config, 0.3, lambda line: told.lines.append(((now[0] - began_ns) / S, line)), background
    )

    def sender(kind, topic):
        from rclpy.qos import DurabilityPolicy, QoSProfile

        kept = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        return other.create_publisher(kind, topic, kept if "static" in topic else 10)

    from sensor_msgs.msg import CameraInfo, Image

    sends = {topic: sender(Image, topic) for topic in topics}
    infos = {topic: sender(CameraInfo, maker._inputs[topic].info) for topic in topics}
    tf, fixed = sender(tf_message(), "/tf"), sender(tf_message(), "/tf_static")

    def send(publisher, data):
        before = maker._subscriptions.messages
        publisher.publish(data)
        for _ in range(2000):
            maker.spin_once()
            if maker._subscriptions.messages > before:
                break
        else:
            raise AssertionError("it did not arrive")

    while not all(one.get_subscription_count() for one in (*sends.values(), *infos.values(), tf, fixed)):
        maker.spin_once()
    made = wire.messages()
    mounts = [("base_link", f"eye{n}", T_BODY_OPTICAL) for n in range(len(topics))]
    send(fixed, wire.packed(made.transforms(0, mounts)))
    for n, topic in enumerate(topics):
        send(infos[topic], wire.packed(made.camera_info(frames[0].camera, START, f"eye{n}")))
    truth = Poses([one.stamp_ns for one in frames], [one.T_world_sensor @ inverse(T_BODY_OPTICAL) for one in frames])
    random, events = np.random.default_rng(0), []
    for k, frame in enumerate(frames):
        for n, topic in enumerate(topics):
            arrived_ns = frame.stamp_ns + round(S * (late_s + random.exponential(0.004)))
            events.append((arrived_ns, topic, n, k))
    for t in range(frames[0].stamp_ns, frames[-1].stamp_ns, POSE_NS):
        events.append((t + round(S * (0.004 + random.exponential(0.001))), "/tf", 0, t))
    for arrived_ns, topic, n, what in sorted(events):
        now[0] = START + arrived_ns
        if topic == "/tf":
            stamp_ns = START + what + round(S * pose_step((what - frames[0].stamp_ns) / S))
            send(tf, wire.packed(made.transforms(stamp_ns, [("odom", "base_link", truth.at(what))])))
        else:
            frame = frames[what]
            stamp_ns = START + frame.stamp_ns + round(S * topics[topic]((frame.stamp_ns - frames[0].stamp_ns) / S))
            send(sends[topic], wire.packed(made.image(frame.depth, stamp_ns, f"eye{n}")))
        maker.spin_once()
    now[0] += 2 * S
    for _ in range(30):
        maker.spin_once()
    maker.close()
    node.destroy_node()
    other.destroy_node()
    return told
