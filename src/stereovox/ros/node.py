# SPDX-License-Identifier: Apache-2.0
"""The node: messages wait for their pose, become frames and update the map, which is published.

Everything runs in one thread between two waits for messages, so nothing needs a lock, and services run between frames.
Only corrections of the map and large messages have threads of their own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from time import monotonic_ns
from typing import Any, NamedTuple

from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import Frame, Rays, UpdateReport
from stereovox.geometry.se3 import inverse
from stereovox.mapping.rebuild import CorrectionReport
from stereovox.ros.inputs import PoseLookup, header
from stereovox.ros.library import StampsByNode
from stereovox.ros.mapping import Mapping, Services
from stereovox.ros.obstacles import Obstacles, score_of
from stereovox.ros.options import Options
from stereovox.ros.outputs import Outputs
from stereovox.ros.poses.clocks import SensorClocks
from stereovox.ros.poses.corrections import AGAIN_S, PathCorrections, corrector_of
from stereovox.ros.poses.pose_source import pose_source
from stereovox.ros.poses.poses import Pose, SensorPoses, fixed_transform
from stereovox.ros.poses.tracking import TrackedDepthInput, TrackedPoses
from stereovox.ros.subscriptions import Silence, Subscriptions
from stereovox.sources.latest import Arrival, Waiting
from stereovox.sources.poses.clock_watch import Heard

IDLE_S, SOON_S = 0.05, 0.005
"""Seconds to wait for messages: when idle, and while frames are waiting."""
MAX_AT_ONCE = 256
"""Most messages received before the next frame is mapped."""


class Message(NamedTuple):
    """A message to map, as bytes; what was known about its stamp when it arrived, and the shift added to the stamp."""

    data: bytes
    heard: Heard = Heard()
    shift_ns: int = 0


class MapNode:
    """Maps live topics. node: rclpy's; on_report: called with the report of each frame.

    Attributes:
        waiting: Messages that wait for their pose.
        received: Number of messages to map, by topic.
        active: Whether frames are mapped; otherwise they are dropped, and nothing is published.

    Raises StereovoxError, one line, for invalid options.
    """

    def __init__(
        self,
        node: Any,
        mapping: Mapping,
        options: Options,
        out: Callable[[], str],
        on_report: Callable[[UpdateReport], None] = lambda report: None,
    ):
        from rclpy.executors import SingleThreadedExecutor

        self._node, self._mapping, self._on_report = node, mapping, on_report
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(getattr(node, "itself", node))
        self.active = True
        self._stamps = StampsByNode(node, mapping.config.trust.stale_s)
        mapping.stamps_by(self._stamps.now_ns)
        self._source = pose_source(node, mapping.config, options, self._stamps.late)
        self._poses = self._source.poses
        for text in options.fixed:
            parent, child, numbers = fixed_transform(text)
            self._poses.tf.add(parent, child, 0, numbers, fixed=True)
        self._inputs = {one.topic: one for one in self._source.inputs(options, mapping.config.dimensions)}
        wait_ns, late_ns = round(1e9 * options.wait_s), round(1e9 * options.late_s)
        self.waiting: Waiting[Message] = Waiting(options.queue, wait_ns, late_ns, monotonic_ns)
        self.received: Counter[str] = Counter()
        self._poses.tf.simulated = bool(node.get_parameter("use_sim_time").value)
        self._clocks = SensorClocks(mapping.config, options.apart_s, lambda line: node.get_logger().warning(line))
        self._outputs = Outputs(node, mapping, options, self.counts)
        self._obstacles = Obstacles(node, mapping, options)
        Services(node, mapping, out, self._renewed, self._source.continuable)
        self._score = score_of(node, mapping, options)
        self._corrector = corrector_of(node, mapping, self._poses, options)
        on_path = self._corrector.on_path if isinstance(self._corrector, PathCorrections) else None
        self._subscriptions = Subscriptions(node, options, self._poses, self._inputs, self._arrived, on_path)
        self._corrections = Counter(corrections=0, corrections_failed=0) if self._corrector else Counter[str]()
        self._silence = Silence(node, self._inputs, self.received)

    def counts(self) -> dict[str, Any]:
        """Return the numbers of messages received, dropped and waiting, and of refused frames by reason."""
        history = self._mapping.history
        return {
            "received": self.received.total(),
            "dropped": self.waiting.dropped.total(),
            "waiting": len(self.waiting),
            "frames_in_map": history.frames,
            "refused_ever": dict(history.refused),
            "transforms_unreadable": self._poses.tf.unreadable,
            **self._source.counts(),
            **self._corrections,
            **(self._score.counts() if self._score else {}),
        }

    def spin_once(self) -> None:
        """Receive messages, map one frame, publish what is due."""
        self._receive(SOON_S if len(self.waiting) else IDLE_S)
        if not self.active:
            self.waiting.clear()
            return
        arrival = self.waiting.pop(self._ready)
        if arrival is not None:
            self._map(arrival)
        if (ended := self._mapping.corrections.poll()) is not None:
            self._take(ended)
        self._outputs.update()
        self._obstacles.update()
        self._source.update()
        if self._score is not None:
            self._score.update()
        self._silence.update()

    def close(self) -> dict[str, Any]:
        """Map all waiting frames, finish corrections, publish the final map; return figures for the report.

        Keys: `localisation`, `slam`, `slam_map` (an OccupancyGrid), `error`; each only if it exists.
        """
        while (arrival := self.waiting.pop(lambda one: True)) is not None:
            self._map(arrival)
        for ended in self._mapping.corrections.rest():
            self._take(ended)
        self._clocks.forget()
        self._outputs.close()
        error = self._score.final() if self._score is not None else {}
        return {**self._source.finish(), **({"error": error} if error else {})}

    def _receive(self, wait_s: float) -> None:
        """Wait for messages and receive all that have arrived."""
        idle = 0  # rclpy returns once without a message after each round of ready ones, even if more have arrived
        for _ in range(MAX_AT_ONCE):
            before = self._subscriptions.messages
            self._executor.spin_once(timeout_sec=wait_s)
            idle = idle + 1 if self._subscriptions.messages == before else 0
            if idle == 2:
                break
            wait_s = 0.0

    def _arrived(self, topic: str, data: bytes) -> None:
        self.received[topic] += 1
        try:
            stamp_ns, frame_id = header(data)
        except ValueError:  # no pose to wait for: the message is refused in its turn
            self.waiting.put(topic, 0, "", Message(data))
            return
        shift_ns = self._clocks.shift_ns(topic)
        stamp_ns += shift_ns
        self._stamps.heard(stamp_ns)
        self.waiting.put(topic, stamp_ns, frame_id, Message(data, self._heard(topic, frame_id, stamp_ns), shift_ns))

    def _heard(self, topic: str, frame_id: str, stamp_ns: int) -> Heard:
        arrived_ns = self._subscriptions.arrived_ns
        if isinstance(self._poses, TrackedPoses) and isinstance(self._inputs[topic], TrackedDepthInput):
            self._poses.images.heard(stamp_ns, arrived_ns)
            return Heard()
        return self._clocks.heard(topic, stamp_ns, arrived_ns, SensorPoses(self._poses, frame_id))

    def _ready(self, one: Arrival[Message]) -> bool:
        sensor = self._inputs[one.sensor]
        if one.content.heard.is_open or not sensor.ready:
            return False
        return sensor.is_final(self._poses, one.frame_id, one.stamp_ns)

    def _map(self, one: Arrival[Message]) -> None:
        sensor, shift_ns = self._inputs[one.sensor], one.content.shift_ns
        frame = sensor.frame(one.content.data, self._look_up(one))
        if frame is None:  # it served to localise the robot, and is not mapped
            return
        if shift_ns:
            frame = replace(frame, stamp_ns=frame.stamp_ns + shift_ns)
        report = self._mapping.add(frame)
        self._on_report(report)
        if self._corrector is not None and isinstance(frame, Frame | Rays) and not frame.fault:
            self._corrector.seen(sensor, one.frame_id, frame, not report.refused)
        if report.refused:
            self._node.get_logger().warning(f"refused: {report.detail}", throttle_duration_sec=5.0)
        else:
            self._outputs.changed(one.stamp_ns, self._poses.world)
            where = self._poses.pose(one.frame_id, one.stamp_ns)  # again, for the pose of the robot
            self._obstacles.seen(one.stamp_ns, self._poses.world, where.T_world_sensor @ inverse(where.T_base_sensor))

    def _look_up(self, one: Arrival[Message]) -> PoseLookup:
        """Return the function that looks up poses for a message by its own stamps, or refuses if these are in doubt."""
        sensor, (data, heard, shift_ns) = self._inputs[one.sensor], one.content
        look_up = sensor.look_up(self._poses)
        try:
            if sensor.ready and one.frame_id:
                self._clocks.check(one.sensor, lambda: sensor.view(data, one.stamp_ns), heard, monotonic_ns())
        except FrameRefused as refused:
            doubt = refused  # lives longer than this clause

            def nowhere(frame_id: str, stamp_ns: int) -> Pose:
                raise doubt

            return nowhere
        return lambda frame_id, stamp_ns: look_up(frame_id, stamp_ns + shift_ns)

    def _take(self, ended: Future[CorrectionReport]) -> None:
        """Publish a correction, or log why it failed."""
        try:
            report = ended.result()
        except StereovoxError as error:
            self._corrections["corrections_failed"] += 1
            self._node.get_logger().warning(f"not corrected: {error}", throttle_duration_sec=AGAIN_S)
            return
        if report.moved:
            self._corrections["corrections"] += 1
            self._outputs.corrected()
            self._node.get_logger().info(f"corrected: {report.moved} frames moved, {report.mapped} mapped again")

    def _renewed(self) -> Any:
        self.waiting.clear()
        self._clocks.forget()
        if self._corrector is not None:
            self._corrector.forget()
        return self._outputs.renewed(self._node.get_clock().now().nanoseconds, self._poses.world or "map")
