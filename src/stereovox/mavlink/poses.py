# SPDX-License-Identifier: Apache-2.0
"""Poses of a vehicle from its autopilot: ODOMETRY, or LOCAL_POSITION_NED with ATTITUDE_QUATERNION or ATTITUDE.

MAVLink's worlds are x north (or ahead), y east (or right), z down, and its body front, right, down; the map's are x
north, y west, z up, and the body in optical axes: `turned(T, "ned", "up")` of `sources.tracker`.

An autopilot's poses as a stream for live cameras: `mavlink:udpin:0.0.0.0:14540`.
"""

from __future__ import annotations

from collections import deque
from functools import cached_property
from math import cos, isfinite, sin
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError, StereovoxError
from stereovox.frame.stamp_clock import epoch_ns
from stereovox.geometry.se2 import lifted
from stereovox.geometry.se3 import Transform, from_quaternion, interpolate
from stereovox.mavlink.link import MavlinkLink, Tell, warn
from stereovox.sources.poses.pose_stream import T_OPTICAL_BODY, PoseStream
from stereovox.sources.poses.tracker import turned

LOCAL_NED, LOCAL_FRD, BODY_FRD = 1, 20, 12
"""MAV_FRAME: the supported worlds and body of ODOMETRY."""
BODIES = (BODY_FRD, 8)
"""The child frame is the velocities', which are not used; 8, MAV_FRAME_BODY_NED, is an older name."""
ATTITUDES = 16
"""Number of latest attitudes kept: a position may arrive before or after the attitudes of its time."""
LONGEST_GAP_NS = 200_000_000
"""Longest time between the attitudes before and after a position."""
OLDEST_NS, NEWEST_NS = 2_000_000_000, 50_000_000
"""Largest age of a pose on arrival, and lead over this machine's clock; beyond, the clocks disagree."""
PREFERRED_NS = 1_000_000_000
"""While ODOMETRY, or ATTITUDE_QUATERNION, came within this time, LOCAL_POSITION_NED, or ATTITUDE, is ignored."""
LONGEST_RESET_NS, RESET_STEPS = 500_000_000, 5
"""Longest time between the poses before and after a reset, also as a multiple of the previous interval: beyond it the
vehicle's motion is unknown."""
MAX_LENGTH_ERROR = 0.01
"""Largest deviation of a quaternion's length from 1."""


class TakesPoses(Protocol):
    """A receiver of poses, such as `LivePoses`."""

    def add(self, stamp_ns: int, T_world_body: NDArray[np.float64]) -> object:
        """Add one pose: T_world_body (4, 4) at a time in nanoseconds."""
        ...


class PoseReceiver:
    """Passes an autopilot's poses to `into`, stamped by this machine's clock.

    When ODOMETRY reports a reset of the autopilot's estimate (`reset_counter`), later poses are shifted and turned
    about the vertical so that they continue the earlier ones: the map stays right, in a world that is no longer the
    autopilot's. This is reported, and so is a gap too long to do it.

    Args:
        connection: A `MavlinkLink`, or the address of one, which is closed with the receiver.
        into: Its `add(stamp_ns, T_world_body)` is called by the reading thread. T_world_body (4, 4) maps the
            vehicle's body (optical axes: x right, y down, z forward) into a world x north, y west, z up, with the
            autopilot's origin, or its origin before a reset. stamp_ns: time of the pose, by the clock of
            the link.
        tell: Called with one line, once per reason, when poses cannot be used.

    Attributes:
        taken: Number of poses passed on.
        passed_over: Number of other poses, by reason.
        link: The connection.

    Raises:
        StereovoxError: As for `MavlinkLink`.
    """

    def __init__(self, connection: str | MavlinkLink, into: TakesPoses, *, tell: Tell = warn):
        self._own = isinstance(connection, str)
        self.link = MavlinkLink(connection, tell=tell) if isinstance(connection, str) else connection
        self._into, self._tell = into, tell
        self.taken = 0
        self.passed_over: dict[str, int] = {}
        self._resets: int | None = None
        self._times_set = self.link.clock.times_set
        self._was_reset, self._T_world_autopilot = False, np.eye(4)
        self._recent: deque[tuple[int, Transform]] = deque(maxlen=2)
        self._last_odometry_ns = self._last_quaternion_ns = -PREFERRED_NS - 1
        self._attitudes: deque[tuple[int, Transform]] = deque(maxlen=ATTITUDES)
        self._position: tuple[int, NDArray[np.float64], int] | None = None
        self._readers = {
            "ODOMETRY": self._odometry,
            "LOCAL_POSITION_NED": self._local_position,
            "ATTITUDE_QUATERNION": self._quaternion,
            "ATTITUDE": self._angles,
        }
        self.link.listen(self._take)

    def close(self) -> None:
        """Stop receiving poses, and close the connection unless it was given."""
        self.link.ignore(self._take)
        if self._own:
            self.link.close()

    def __enter__(self) -> PoseReceiver:
        """Return itself."""
        return self

    def __exit__(self, *_: Any) -> None:
        """Stop receiving poses."""
        self.close()

    def _take(self, message: Any, came_ns: int) -> None:
        reader = self._readers.get(message.get_type())
        if reader is not None:
            reader(message, came_ns)

    def _odometry(self, message: Any, came_ns: int) -> None:
        self._last_odometry_ns = came_ns
        if message.frame_id not in (LOCAL_NED, LOCAL_FRD) or message.child_frame_id not in BODIES:
            frames = f"{message.frame_id} and {message.child_frame_id}"
            return self._pass_over("frame", f"ODOMETRY is in frames {frames}; LOCAL_NED (1) or LOCAL_FRD (20) is read")
        if message.quality == -1:
            return self._pass_over("quality", "the autopilot says that its odometry has failed")
        self._was_reset |= self._resets not in (None, message.reset_counter)
        self._resets = message.reset_counter
        T = _pose([message.x, message.y, message.z], message.q)
        self._hand_on(message.time_usec * 1000, T, came_ns)

    def _local_position(self, message: Any, came_ns: int) -> None:
        if came_ns - self._last_odometry_ns > PREFERRED_NS:
            self._position = message.time_boot_ms * 1_000_000, np.array([message.x, message.y, message.z]), came_ns
            self._combine()

    def _quaternion(self, message: Any, came_ns: int) -> None:
        self._last_quaternion_ns = came_ns
        T = _pose([0, 0, 0], [message.q1, message.q2, message.q3, message.q4])
        self._turn(message.time_boot_ms * 1_000_000, T)

    def _angles(self, message: Any, came_ns: int) -> None:
        if came_ns - self._last_quaternion_ns > PREFERRED_NS:
            self._turn(message.time_boot_ms * 1_000_000, _of_angles(message.roll, message.pitch, message.yaw))

    def _turn(self, remote_ns: int, T: Transform | None) -> None:
        if T is None:
            return self._pass_over("not finite", "the autopilot sends attitudes that are no rotations")
        if self._attitudes and remote_ns <= self._attitudes[-1][0]:  # started again, or out of order
            self._attitudes.clear()
        self._attitudes.append((remote_ns, T))
        self._combine()

    def _combine(self) -> None:
        """Combine the waiting position with an attitude, once one of its time or later is there."""
        if self._position is None or not self._attitudes or self._attitudes[-1][0] < self._position[0]:
            return
        (at_ns, xyz, came_ns), self._position = self._position, None
        before = [k for k, (stamp_ns, _) in enumerate(self._attitudes) if stamp_ns <= at_ns]
        (first_ns, first), (then_ns, then) = (
            (self._attitudes[k] for k in (before[-1], min(before[-1] + 1, len(self._attitudes) - 1)))
            if before
            else ((0, np.eye(4)), (at_ns + LONGEST_GAP_NS, np.eye(4)))
        )
        if then_ns - first_ns > LONGEST_GAP_NS:
            return self._pass_over("no attitude", "positions come without an attitude before and after them")
        pose = interpolate(first, then, (at_ns - first_ns) / max(then_ns - first_ns, 1))
        pose[:3, 3] = xyz
        self._hand_on(at_ns, pose, came_ns)

    def _hand_on(self, remote_ns: int, T_ned_frd: Transform | None, came_ns: int) -> None:
        if T_ned_frd is None or not np.isfinite(T_ned_frd).all():
            return self._pass_over("not finite", "the autopilot sends poses that are no numbers")
        self.link.clock.heard(remote_ns, came_ns)
        if self.link.clock.times_set != self._times_set:
            self._times_set = self.link.clock.times_set
            self._tell(f"{self.link.url}: the autopilot's clock was set; its poses are used again once it is known")
        stamp_ns = self.link.clock.local_ns(remote_ns)
        if stamp_ns is None:
            return self._pass_over("clock", "the autopilot's clock is not known yet; poses are used once it is")
        if not -NEWEST_NS <= came_ns - stamp_ns <= OLDEST_NS:
            age_s = (came_ns - stamp_ns) / 1e9
            return self._pass_over("stamp", f"poses seem to be {age_s:.2f} s old; are their times those of TIMESYNC?")
        T_autopilot_body = turned(T_ned_frd[None], "ned", "up")[0]
        if self._was_reset:
            self._was_reset = False
            self._go_on(stamp_ns, T_autopilot_body)
        T_world_body = self._T_world_autopilot @ T_autopilot_body
        self._recent.append((stamp_ns, T_world_body))
        self.taken += 1
        self._into.add(stamp_ns, T_world_body)

    def _go_on(self, stamp_ns: int, T_autopilot_body: Transform) -> None:
        """Continue from the pose expected without the reset, including the turn about the vertical."""
        words, expected = "the autopilot's position was reset", self._expected(stamp_ns)
        if expected is None:
            self._tell(f"{words}: poses jump, and what is mapped stays where it is")
            return
        R = expected[:3, :3] @ T_autopilot_body[:3, :3].T
        T = lifted((0.0, 0.0, np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])))
        T[:3, 3] = expected[:3, 3] - T[:3, :3] @ T_autopilot_body[:3, 3]
        self._T_world_autopilot = T
        self._tell(f"{words}: poses go on from those before it")

    def _expected(self, stamp_ns: int) -> Transform | None:
        """Return the pose extrapolated from the last two, None if they are too old."""
        if len(self._recent) < 2:
            return None
        (first_ns, first), (then_ns, then) = self._recent
        step_ns, ahead_ns = then_ns - first_ns, stamp_ns - then_ns
        if step_ns <= 0 or not 0 <= ahead_ns <= min(LONGEST_RESET_NS, RESET_STEPS * step_ns):
            return None
        return interpolate(first, then, 1 + ahead_ns / step_ns)

    def _pass_over(self, reason: str, line: str) -> None:
        self.passed_over[reason] = self.passed_over.get(reason, 0) + 1
        if self.passed_over[reason] == 1:
            self._tell(f"{self.link.url}: {line}")


def receive_poses(connection: str | MavlinkLink, into: TakesPoses, *, tell: Tell = warn) -> PoseReceiver:
    """Pass an autopilot's poses to `into` until the receiver is closed; see `PoseReceiver`.

    Args:
        connection: A `MavlinkLink`, or the address of one.
        into: Receiver of the poses.
        tell: Called with one line when poses cannot be used.

    Returns:
        The receiver, already running.

    Raises:
        StereovoxError: As for `MavlinkLink`.
    """
    return PoseReceiver(connection, into, tell=tell)


def _pose(xyz: list[float], wxyz: list[float]) -> Transform | None:
    """Return the motion of a position and a quaternion w, x, y, z; None if they are invalid."""
    w, x, y, z = wxyz
    if not all(map(isfinite, (*xyz, *wxyz))) or abs(np.linalg.norm(wxyz) - 1) > MAX_LENGTH_ERROR:
        return None
    return from_quaternion(xyz, [x, y, z, w])


def _of_angles(roll: float, pitch: float, yaw: float) -> Transform | None:
    """Return the rotation by yaw, then pitch, then roll, in radians about the body's own axes."""
    if not all(map(isfinite, (roll, pitch, yaw))):
        return None
    half = [(cos(a / 2), sin(a / 2)) for a in (roll, pitch, yaw)]
    (cr, sr), (cp, sp), (cy, sy) = half
    return from_quaternion(
        [0, 0, 0],
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
    )


PREFIX = "mavlink:"


class MavlinkPoses(PoseStream):
    """ODOMETRY, or LOCAL_POSITION_NED with attitudes, of an autopilot, synchronised by TIMESYNC.

    where: `mavlink:` and an address of `MavlinkLink`. Stamps are nanoseconds since 1970 by this machine's clock, which
    cameras also use. World x north, y west, z up; body x forward, y left, z up. See `PoseReceiver`.

    Attributes:
        url: The address.
    """

    def __init__(self, where: str):
        super().__init__(where)
        self.url = where.removeprefix(PREFIX)
        self._receiver: PoseReceiver | None = None

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` names an autopilot."""
        return where.startswith(PREFIX)

    @cached_property
    def link(self) -> MavlinkLink:
        """The connection, opened on first use; obstacle distances may use it too."""
        try:
            return MavlinkLink(self.url, clock=epoch_ns, tell=self._note)
        except StereovoxError as error:
            raise SourceError(str(error)) from None

    def start(self) -> None:
        """Start listening."""
        self._receiver = PoseReceiver(self.link, self, tell=self._note)
        super().start()

    def stop(self) -> None:
        """Stop listening."""
        super().stop()
        if self._receiver is not None:
            self._receiver.close()
            self.counts.update(self._receiver.passed_over)
            self._receiver = None
        if "link" in vars(self):
            self.link.close()

    def add(self, stamp_ns: int, T_world_body: Transform) -> None:
        """Add a pose of the body in optical axes."""
        self.poses.add(stamp_ns, T_world_body @ T_OPTICAL_BODY)

    def _receive(self) -> None:
        self._stopped.wait()

    def _note(self, line: str) -> None:
        self.trouble = line
