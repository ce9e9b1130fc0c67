# SPDX-License-Identifier: Apache-2.0
"""Subscriptions of the node. Messages stay bytes, which the bag readers parse; nothing is parsed twice.

If the quality of service of a publisher does not match, rclpy logs "offering incompatible QoS".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from time import monotonic, monotonic_ns
from typing import Any

from stereovox.errors import StereovoxError, one_line
from stereovox.frame.stamp_clock import epoch_ns
from stereovox.ros.inputs import DepthInput, Input
from stereovox.ros.options import Options, split_pair
from stereovox.ros.poses.poses import PoseBuffer
from stereovox.ros.poses.tf_message import tf_message
from stereovox.runs.pose_choice import TRACK

FIRST_S, AGAIN_S = 5.0, 30.0
"""Seconds until the first warning, and between repeated ones."""
TF2_MSGS = "Source a ROS 2 distribution (source /opt/ros/jazzy/setup.bash) or build it (docs/ros2.md)"
"""How to get `tf2_msgs`: it is not on PyPI."""
LONGEST_NS = 10_000_000_000
"""A message that waited in the middleware for longer has no usable time of reception."""
POSE_QUEUE = 100
"""Length of the middleware's queues for pose messages."""


class Silence:
    """Warns about topics without a message so far. received: number of messages by topic."""

    def __init__(
        self,
        node: Any,
        inputs: Mapping[str, Input],
        received: Mapping[str, int],
        clock: Callable[[], float] = monotonic,
    ):
        self._node, self._inputs, self._received, self._clock = node, inputs, received, clock
        self._next = clock() + FIRST_S

    def update(self) -> None:
        """Warn if a warning is due."""
        now = self._clock()
        if now < self._next:
            return
        self._next = now + AGAIN_S
        for topic, one in self._inputs.items():
            if not self._received.get(topic):
                self._node.get_logger().warning(f"no message on {topic}: {self._why(topic, one.kind)}")

    def _why(self, topic: str, kind: str) -> str:
        if self._node.count_publishers(topic):
            return "it is published, but no message arrives; see docs/ros2.md: large images need larger buffers"
        type_name = kind.replace("/", "/msg/")
        others = sorted(
            name
            for name, types in self._node.get_topic_names_and_types()
            if type_name in types and self._node.count_publishers(name)
        )
        if others:
            return f"nobody publishes it, but {kind} is on {', '.join(others)}"
        return f"nobody publishes it, nor {kind} on any topic; is the camera running, with the same ROS_DOMAIN_ID?"


class Subscriptions:
    """Subscribes to all topics in the options, and to /tf and /tf_static.

    arrived: called with topic and bytes of a message to map. on_path: called with the bytes of a corrected path.
    messages: number of messages received, of all kinds. arrived_ns: when the last one arrived, monotonic.
    Raises StereovoxError, one line, for an invalid topic name, and if nothing can give a pose: no /tf, since `tf2_msgs`
    is missing, and no other source of poses in the options.
    """

    def __init__(
        self,
        node: Any,
        options: Options,
        where: PoseBuffer,
        inputs: Mapping[str, Input],
        arrived: Callable[[str, bytes], None],
        on_path: Callable[[bytes], None] | None = None,
    ):
        self._node, self._where, self.messages, self.arrived_ns = node, where, 0, 0
        images = _qos(options.queue, options.reliable)
        for topic, one in inputs.items():
            self._listen(one.kind, topic, partial(arrived, topic), images)
            if isinstance(one, DepthInput):
                self._listen("sensor_msgs/CameraInfo", one.info, one.on_camera_info, images)
        poses = _qos(POSE_QUEUE, reliable=False)
        for topic in options.odometry:
            self._listen("nav_msgs/Odometry", topic, where.on_odometry, poses)
        for topic, child in map(split_pair, options.pose):
            self._listen("geometry_msgs/PoseStamped", topic, partial(where.on_pose, child=child), poses)
        if on_path is not None:
            self._listen("nav_msgs/Path", options.corrected_path, on_path, _qos(1, reliable=True))
        self._listen_to_tf(where, options)

    def _listen_to_tf(self, where: PoseBuffer, options: Options) -> None:
        kind = tf_message()
        tracked = options.poses == TRACK
        if kind is None and not (tracked or options.odometry or options.pose or options.fixed):
            raise StereovoxError(
                f"no poses: tf2_msgs is not installed. {TF2_MSGS}, or give --odometry, --pose or --poses track"
            )
        if kind is None:
            others = "mounts come from ros.fixed" if tracked else "poses come from ros.odometry, ros.pose and ros.fixed"
            self._node.get_logger().warning(f"tf2_msgs is not installed, so /tf is ignored: {others} alone. {TF2_MSGS}")
            return
        moving, fixed = partial(where.on_tf, fixed=False), partial(where.on_tf, fixed=True)
        self._subscribe(kind, "/tf", moving, _qos(POSE_QUEUE, reliable=True))
        self._subscribe(kind, "/tf_static", fixed, _qos(POSE_QUEUE, reliable=True, latched=True))

    def _listen(self, kind: str, topic: str, callback: Callable[[bytes], None], qos: Any) -> None:
        package, _, name = kind.partition("/")
        self._subscribe(getattr(import_module(f"{package}.msg"), name), topic, callback, qos)

    def _subscribe(self, kind: Any, topic: str, callback: Callable[[bytes], None], qos: Any) -> None:
        def receive(data: bytes, info: Mapping[str, int]) -> None:
            self.messages += 1
            self._where.tf.arrived_ns = self.arrived_ns = arrived(info)
            callback(data)

        from rclpy.exceptions import InvalidTopicNameException

        try:
            self._node.create_subscription(kind, topic, receive, qos, raw=True)
        except InvalidTopicNameException as error:
            raise StereovoxError(f"topic '{topic}': {one_line(str(error).splitlines()[0].rstrip(':'))}") from None


def arrived(info: Mapping[str, int]) -> int:
    """Return when a message was received, in monotonic nanoseconds, by rclpy's record; now without one."""
    waited_ns = epoch_ns() - info.get("received_timestamp", 0)
    return monotonic_ns() - (waited_ns if 0 <= waited_ns <= LONGEST_NS else 0)


def _qos(depth: int, reliable: bool, latched: bool = False) -> Any:
    """Return a quality of service. latched: also receive the last message sent before."""
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
