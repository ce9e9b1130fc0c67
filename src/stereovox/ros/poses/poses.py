# SPDX-License-Identifier: Apache-2.0
"""Buffer the poses of the sensors in the map's frame, from /tf, odometry, pose topics and fixed transforms."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable
from contextlib import suppress
from threading import RLock
from time import monotonic_ns
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, StereovoxError
from stereovox.geometry.se3 import Transform
from stereovox.ros.poses.clocks import Pace
from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.robot_messages import StampedTransform, frame_name, read_odometry, read_transforms
from stereovox.sources.bags.tf import Edge, Limits, Tf, tf_poses
from stereovox.sources.poses.live_poses import REORDERED_NS, RESET_NS, SET_BACK
from stereovox.sources.poses.poses import Poses, seconds_from_ns
from stereovox.sources.robots.frames import BASES

MAX_TRANSFORMS = 2000
"""Most transforms kept per frame; when there are more, the older half is dropped."""


class _Late(NamedTuple):
    """A transform that is older than an earlier one, and when it arrived."""

    stamp_ns: int
    numbers: tuple[float, ...]
    arrived_ns: int


class LiveEdge(Edge):
    """Recent poses of a frame in its parent; one thread may add some while others look them up.

    arrived: returns when the transform that is added arrived, monotonic. simulated: as for `Pace`.

    A frame that has not moved may still move: unlike in a recording, it is never treated as fixed.

    A clock that is set back a little shows as in `LivePoses`: transforms older than the newest one advance with time.
    Then all earlier transforms with later stamps are dropped; two clocks are never mixed.

    Attributes:
        pace: The pace of its transforms.
    """

    def __init__(self, parent: str, child: str, arrived: Callable[[], int] = monotonic_ns, simulated: bool = False):
        super().__init__(parent, child)
        self.pace, self._arrived = Pace(simulated), arrived
        self._newest_ns: int | None = None
        self._late: list[_Late] = []
        self._lock = RLock()

    def add(self, stamp_ns: int, numbers: Iterable[float]) -> None:
        """Add tx ty tz qx qy qz qw at a time."""
        one = _Late(int(stamp_ns), tuple(numbers), self._arrived())
        self.pace.heard(one.stamp_ns, one.arrived_ns)
        with self._lock:
            if self._newest_ns is not None and one.stamp_ns < self._newest_ns - RESET_NS:
                self.clear()
            if self._newest_ns is None or one.stamp_ns > self._newest_ns:
                self._put_late()
                self._put(one)
            elif one.stamp_ns < self._newest_ns:
                self._take_late(one, self._newest_ns)

    def clear(self) -> None:
        """Drop all poses so far."""
        with self._lock:
            self._keep(0)
            self._late, self._newest_ns, self._sorted = [], None, None

    def stamps(self, first_ns: int, last_ns: int) -> list[int]:
        """Return the times of the transforms in a span of time, with one more at either end."""
        stamps, _ = self._in_order()
        begin = max(int(np.searchsorted(stamps, first_ns)) - 1, 0)
        return stamps[begin : int(np.searchsorted(stamps, last_ns)) + 1].tolist()

    def _take_late(self, one: _Late, newest_ns: int) -> None:
        if self._late and one.stamp_ns <= self._late[-1].stamp_ns:
            self._put_late()
        self._late.append(one)
        if newest_ns - one.stamp_ns <= REORDERED_NS:
            self._put(one)
        if len(self._late) >= SET_BACK:
            first = self._late[0]
            if 2 * (one.arrived_ns - first.arrived_ns) > one.stamp_ns - first.stamp_ns:
                self._drop_from(first.stamp_ns)
            self._put_late()

    def _put_late(self) -> None:
        late, self._late = self._late, []
        for one in late:  # of two with the same time the first counts
            self._put(one)

    def _put(self, one: _Late) -> None:
        if len(self._stamps) >= MAX_TRANSFORMS:
            self._keep(MAX_TRANSFORMS // 2)
        super().add(one.stamp_ns, one.numbers)
        self._newest_ns = one.stamp_ns if self._newest_ns is None else max(self._newest_ns, one.stamp_ns)

    def _drop_from(self, stamp_ns: int) -> None:
        left = [k for k, stamp in enumerate(self._stamps) if stamp < stamp_ns]
        rows = self._rows
        self._rows = array("d", [number for k in left for number in rows[7 * k : 7 * k + 7]])
        self._stamps = array("q", [self._stamps[k] for k in left])
        self._newest_ns = max(self._stamps, default=None)

    def _keep(self, newest: int) -> None:
        del self._stamps[: len(self._stamps) - newest]
        del self._rows[: len(self._rows) - 7 * newest]

    def _in_order(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        with self._lock:
            return super()._in_order()

    def _is_still(self, rows: NDArray[np.float64]) -> bool:
        return False


class LiveTf(Tf):
    """Transforms between the frames of a running robot.

    Attributes:
        arrived_ns: When the message being read arrived, monotonic; None: now.
        simulated: As for `Pace`; applies to frames that appear later.
    """

    arrived_ns: int | None = None
    simulated = False

    def forget(self, parent: str, child: str) -> None:
        """Drop all poses of a frame in its parent so far."""
        edge = self._edge(parent, child)
        assert isinstance(edge, LiveEdge)
        edge.clear()

    def mover(self, target: str, source: str) -> LiveEdge | None:
        """Return the moving edge nearest to `source`; None if nothing moves or connects the frames."""
        try:
            up, down = self._path(frame_name(target), frame_name(source))
        except FrameRefused:
            return None
        return next((one for one in (*down, *up) if isinstance(one, LiveEdge) and not one.fixed), None)

    def _new_edge(self, parent: str, child: str) -> Edge:
        def arrived() -> int:
            return monotonic_ns() if self.arrived_ns is None else self.arrived_ns

        return LiveEdge(parent, child, arrived, self.simulated)


class Pose(NamedTuple):
    """T_world_sensor (4, 4), T_base_sensor (4, 4), and nanoseconds by which the pose is extrapolated."""

    T_world_sensor: Transform
    T_base_sensor: Transform
    off_ns: int


class SensorPoses:
    """Poses of a frame in the world as they arrive; raises FrameRefused instead of extrapolating."""

    def __init__(self, poses: PoseBuffer, frame_id: str):
        self._poses, self._frame_id = poses, frame_id

    @property
    def pace(self) -> Pace | None:
        """The pace of their messages; None while nothing moves the frame."""
        return self._poses.pace(self._frame_id)

    def at(self, stamp_ns: int) -> Transform:
        """Return T_world_frame (4, 4) at a time."""
        pose = self._poses.pose(self._frame_id, stamp_ns)
        if pose.off_ns:
            raise FrameRefused("no_pose", f"{self._frame_id} has no pose at {seconds_from_ns(stamp_ns)} s")
        return pose.T_world_sensor

    def between(self, first_ns: int, last_ns: int) -> Poses | None:
        """Return the poses in a span of time, with one more at either end; None if there are fewer than two."""
        mover, found = self._poses.mover(self._frame_id), dict[int, Transform]()
        for stamp_ns in mover.stamps(first_ns, last_ns) if mover else ():
            with suppress(FrameRefused):
                found[stamp_ns] = self.at(stamp_ns)
        return Poses(list(found), list(found.values()), where="/tf") if len(found) > 1 else None


class PoseBuffer:
    """Receives messages as CDR bytes and looks up poses.

    world, base: frames of the map and of the robot; "": the first usual one that appears, which is then kept.
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

    def mover(self, frame_id: str) -> LiveEdge | None:
        """Return the edge that moves a frame in the world; None if it is unknown."""
        try:
            return self.tf.mover(self._world_of(frame_id), frame_id)
        except FrameRefused:
            return None

    def pace(self, frame_id: str) -> Pace | None:
        """Return the pace of the poses of a frame in the world; None if it is unknown."""
        mover = self.mover(frame_id)
        return mover.pace if mover else None

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
