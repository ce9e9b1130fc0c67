# SPDX-License-Identifier: Apache-2.0
"""The node: messages wait for their pose, become frames and update the map, which is published.

Everything runs in one thread between two waits for messages, so nothing needs a lock and services run between frames;
but the map is corrected, and large messages are made, in threads of their own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from time import monotonic_ns
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.frame import Frame, UpdateReport
from stereovox.pose_choice import TRACK
from stereovox.rebuild import CorrectionReport
from stereovox.ros.corrections import AGAIN_S, PathCorrections, corrector_of
from stereovox.ros.inputs import CloudInput, DepthInput, FloorCloudInput, Input, ScanInput, header
from stereovox.ros.mapping import Mapping
from stereovox.ros.motion import MotionPublisher
from stereovox.ros.options import Options, split_pair
from stereovox.ros.outputs import Outputs
from stereovox.ros.poses import PoseBuffer, fixed_transform
from stereovox.ros.services import Services
from stereovox.ros.subscriptions import Silence, Subscriptions
from stereovox.ros.tracking import TrackedDepthInput, TrackedPoses, Tracking
from stereovox.sources.waiting import Arrival, Waiting

IDLE_S, SOON_S = 0.05, 0.005
"""Seconds to wait for messages: when idle, and while frames are waiting."""
MAX_AT_ONCE = 256
"""Messages that are received before the next frame is mapped."""


class MapNode:
    """Maps live topics. node: rclpy's; on_report: called with the report of each frame.

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
        self._executor.add_node(node)
        self._poses, self.tracking = _poses(node, mapping, options)
        for text in options.fixed:
            parent, child, numbers = fixed_transform(text)
            self._poses.tf.add(parent, child, 0, numbers, fixed=True)
        self._inputs = {one.topic: one for one in _inputs(options, mapping.config.dimensions, self.tracking)}
        wait_ns, late_ns = round(1e9 * options.wait_s), round(1e9 * options.late_s)
        self.waiting: Waiting[bytes] = Waiting(options.queue, wait_ns, late_ns, monotonic_ns)
        self.received: Counter[str] = Counter()
        self._outputs = Outputs(node, mapping, options, self.counts)
        Services(node, mapping, out, self._renewed, tracked=self.tracking is not None)
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
            **(self.tracking.counts() if self.tracking else {}),
            **self._corrections,
        }

    def spin_once(self) -> None:
        """Receive messages, map one frame, publish what is due."""
        self._receive(SOON_S if len(self.waiting) else IDLE_S)
        arrival = self.waiting.pop(self._ready)
        if arrival is not None:
            self._map(arrival)
        if (ended := self._mapping.corrections.poll()) is not None:
            self._take(ended)
        self._outputs.update()
        self._silence.update()

    def close(self) -> None:
        """Map all waiting frames, correct the map as was asked, and publish the final one."""
        while (arrival := self.waiting.pop(lambda one: True)) is not None:
            self._map(arrival)
        for ended in self._mapping.corrections.rest():
            self._take(ended)
        self._outputs.close()

    def _receive(self, wait_s: float) -> None:
        """Wait for messages and receive all that are there."""
        idle = 0  # rclpy returns without a message once after each round of ready ones, even if more have arrived
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
        except ValueError:  # no pose to wait for: it is refused in its turn
            stamp_ns, frame_id = 0, ""
        self.waiting.put(topic, stamp_ns, frame_id, data)

    def _ready(self, one: Arrival[bytes]) -> bool:
        sensor = self._inputs[one.sensor]
        return sensor.ready and sensor.is_final(self._poses, one.frame_id, one.stamp_ns)

    def _map(self, one: Arrival[bytes]) -> None:
        sensor = self._inputs[one.sensor]
        frame = sensor.frame(one.content, self._poses.pose)
        report = self._mapping.add(frame)
        self._on_report(report)
        if self._corrector is not None and isinstance(frame, Frame) and not frame.fault:
            self._corrector.seen(sensor, one.frame_id, frame, not report.refused)
        if report.refused:
            self._node.get_logger().warning(f"refused: {report.detail}", throttle_duration_sec=5.0)
        else:
            self._outputs.changed(one.stamp_ns, self._poses.world)

    def _take(self, ended: Future[CorrectionReport]) -> None:
        """Publish what a correction has changed, or say why it has not."""
        try:
            report = ended.result()
        except StereovoxError as error:
            self._corrections["corrections_failed"] += 1
            self._node.get_logger().warning(f"not corrected: {error}", throttle_duration_sec=AGAIN_S)
            return
        if report.moved:
            self._corrections["corrections"] += 1
            self._outputs.corrected()
            self._node.get_logger().info(f"corrected: {report.moved} frames moved, {report.mapped} were mapped again")

    def _renewed(self) -> None:
        self.waiting.clear()
        if self._corrector is not None:
            self._corrector.forget()
        self._outputs.changed(self._node.get_clock().now().nanoseconds, self._poses.world or "map")


def _poses(node: Any, mapping: Mapping, options: Options) -> tuple[PoseBuffer, Tracking | None]:
    """Return where poses come from, and what tracks the first depth camera, if they are tracked."""
    names = options.world_frame, options.base_frame, options.extrapolate_s
    if options.poses != TRACK:
        return PoseBuffer(*names), None
    poses = TrackedPoses(*names, base_needed=mapping.config.dimensions == 2)
    return poses, Tracking(mapping.config, poses, MotionPublisher(node, options.publish_tf).publish)


def _inputs(options: Options, dimensions: int, tracking: Tracking | None) -> list[Input]:
    clouds = [FloorCloudInput(topic) if dimensions == 2 else CloudInput(topic, options.cloud_step_deg)
              for topic in options.cloud]  # fmt: skip
    depth = [DepthInput(*split_pair(text)) for text in options.depth]
    if tracking is not None:
        depth[0] = TrackedDepthInput(*split_pair(options.depth[0]), tracking)
    return [*depth, *clouds, *map(ScanInput, options.scan)]
