# SPDX-License-Identifier: Apache-2.0
"""Buffer the poses of the sensors in the map's frame, from /tf, odometry, pose topics and fixed transforms."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, StereovoxError
from stereovox.se3 import Transform
from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.robot_messages import StampedTransform, frame_name, read_odometry, read_transforms
from stereovox.sources.bags.tf import Edge, Limits, Tf, tf_poses
from stereovox.sources.robots.frames import BASES

MAX_TRANSFORMS = 2000
"""Transforms kept per frame; the older half is dropped when there are more."""
RESET_NS = 1_000_000_000
"""A transform this much older than the newest one means that the clock was set back: all before it are dropped."""


class LiveEdge(Edge):
    """Recent poses of a frame in its parent.

    A frame that has not moved may still move: unlike in a recording, it is never treated as fixed.
    """

    def add(self, stamp_ns: int, numbers: Iterable[float]) -> None:
        """Add tx ty tz qx qy qz qw at a time."""
        if self._stamps and stamp_ns < max(self._stamps[-MAX_TRANSFORMS // 8 :]) - RESET_NS:
            self._keep(0)
        elif len(self._stamps) >= MAX_TRANSFORMS:
            self._keep(MAX_TRANSFORMS // 2)
        super().add(stamp_ns, numbers)

    def clear(self) -> None:
        """Drop all poses so far."""
        self._keep(0)
        self._sorted = None

    def _keep(self, newest: int) -> None:
        del self._stamps[: len(self._stamps) - newest]
        del self._rows[: len(self._rows) - 7 * newest]

    def _in_order(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        ordered = super()._in_order()
        self._still = False
        return ordered


class LiveTf(Tf):
    """Transforms between the frames of a running robot."""

    edge: ClassVar[type[Edge]] = LiveEdge

    def forget(self, parent: str, child: str) -> None:
        """Drop all poses of a frame in its parent so far."""
        edge = self._edge(parent, child)
        assert isinstance(edge, LiveEdge)
        edge.clear()


class Pose(NamedTuple):
    """T_world_sensor (4, 4), T_base_sensor (4, 4), and nanoseconds by which the pose is extrapolated."""

    T_world_sensor: Transform
    T_base_sensor: Transform
    off_ns: int


class PoseBuffer:
    """Receives messages as CDR bytes and looks up poses.

    world, base: frames of the map and of the robot; "": the first of the usual ones to appear, which is then kept.
    extrapolate_s: seconds by which a pose may be extrapolated.
    """

    def __init__(self, world: str, base: str, extrapolate_s: float):
        self.world, self._base = frame_name(world), frame_name(base)
        self.tf = LiveTf("/tf", Limits(extrapolate_s=extrapolate_s))

    def on_tf(self, data: bytes, fixed: bool) -> None:
        """Add a `tf2_msgs/TFMessage`; fixed: from /tf_static."""
        try:
            transforms = read_transforms(Wire(data, cdr=True))
        except ValueError:
            self.tf.unreadable += 1
            return
        for one in transforms:
            self._add(one, fixed)

    def on_odometry(self, data: bytes) -> None:
        """Add a `nav_msgs/Odometry`: the pose of its child_frame_id in its frame_id."""
        try:
            one = read_odometry(Wire(data, cdr=True))
        except ValueError:
            self.tf.unreadable += 1
            return
        self._add(one)

    def on_pose(self, data: bytes, child: str) -> None:
        """Add a `geometry_msgs/PoseStamped`: the pose of frame `child` in its frame_id."""
        try:
            wire = Wire(data, cdr=True)
            (stamp_ns, parent), numbers = wire.header(), wire.numbers("d", 7)
        except ValueError:
            self.tf.unreadable += 1
            return
        self._add(StampedTransform(stamp_ns, parent, child, numbers))

    def is_final(self, frame_id: str, stamp_ns: int) -> bool:
        """Return whether a pose is final: no later message can change it."""
        try:
            return self.tf.off_ns(self._world_of(frame_id), frame_id, stamp_ns) == 0
        except FrameRefused:
            return False

    def pose(self, frame_id: str, stamp_ns: int) -> Pose:
        """Return the pose of frame `frame_id` in the world at a time; raises FrameRefused `no_pose`."""
        world, base = self._world_of(frame_id), self._base_of(frame_id)
        T_base_sensor = np.eye(4) if base == frame_id else self.tf.lookup(base, frame_id, stamp_ns)
        T_world_sensor = self.tf.lookup(world, frame_id, stamp_ns)
        self.world, self._base = world, base
        return Pose(T_world_sensor, T_base_sensor, self.tf.off_ns(world, frame_id, stamp_ns))

    def _add(self, one: StampedTransform, fixed: bool = False) -> None:
        self.tf.add(one.parent, one.child, one.stamp_ns, one.numbers, fixed)

    def _world_of(self, frame_id: str) -> str:
        if self.world:
            return self.world
        found = tf_poses(self.tf, frame_id)
        if isinstance(found, str):
            cure = "is the odometry running? ros.world_frame names another frame; without odometry give --poses track"
            raise FrameRefused("no_pose", f"{found}; {cure}")
        return found.world

    def _base_of(self, frame_id: str) -> str:
        return self._base or next((name for name in BASES if self.tf.connected(name, frame_id)), frame_id)


def fixed_transform(text: str) -> tuple[str, str, tuple[float, ...]]:
    """Parse `PARENT CHILD x y z yaw pitch roll` (metres, radians) into parent, child and tx ty tz qx qy qz qw.

    Raises StereovoxError, one line, for anything else.
    """
    words = text.split()
    try:
        x, y, z, *turn = map(float, words[2:])
        yaw, pitch, roll = np.array(turn) / 2
        if words[0] == words[1] or not np.isfinite((x, y, z, yaw, pitch, roll)).all():
            raise ValueError
    except ValueError:
        raise StereovoxError(f"ros.fixed '{text}': write PARENT CHILD x y z yaw pitch roll") from None
    (cy, sy), (cp, sp), (cr, sr) = ((float(np.cos(half)), float(np.sin(half))) for half in (yaw, pitch, roll))
    quaternion = (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    return words[0], words[1], (x, y, z, *quaternion)
