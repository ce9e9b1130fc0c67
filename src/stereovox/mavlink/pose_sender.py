# SPDX-License-Identifier: Apache-2.0
"""The vehicle's pose for an autopilot that has no GPS: ODOMETRY or VISION_POSITION_ESTIMATE, and silence when lost.

The current pose of a body: its newest pose, extrapolated by its last motion.
"""

from __future__ import annotations

import threading
from collections import deque
from math import asin, atan2, cos, sin
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.frame.stamp_clock import RESET_NS, StampClock, epoch_ns
from stereovox.geometry.se3 import Transform, apart, interpolate, orthonormalise, rigidity_error, rotation_vector
from stereovox.kernels.threads import MapLock
from stereovox.mavlink.link import MavlinkLink, Tell, warn
from stereovox.sources.poses.live_poses import MAX_SPEED_MPS, MAX_TURN_DPS, RIGID

PoseMessage = Literal["odometry", "vision_position_estimate"]
POSE_MESSAGES: tuple[PoseMessage, ...] = ("odometry", "vision_position_estimate")
FRD = np.diag([1.0, -1.0, -1.0])
"""Forward, left, up to forward, right, down, and back."""
LOCAL_FRD, BODY_FRD, BY_VISION = 20, 12, 2
"""MAV_FRAME_LOCAL_FRD, MAV_FRAME_BODY_FRD, MAV_ESTIMATOR_TYPE_VISION."""
HIGHEST_RATE_HZ, EARLY = 200.0, 0.25
"""Most messages a second, and the share of a period by which one may be sent early: cameras are not punctual."""
LONGEST_GAP_NS = 500_000_000
"""Between two poses, for a velocity."""
STANDS_M, STANDS_RAD = 0.05, 0.04
"""By which poses may differ at any time without being a jump."""
FARTHEST_M, WIDEST = 1e6, 1e30
"""Least position, and least entry of a covariance, that is never a measured one."""
STEEPEST = 0.01
"""Least cosine of the pitch at which roll and yaw, and so their covariance, mean anything."""


class PoseSender:
    """Sends poses to an autopilot as its external position; PX4 and ArduPilot read both messages.

    ODOMETRY is in the frames MAV_FRAME_LOCAL_FRD and MAV_FRAME_BODY_FRD, with the velocity between the last two poses;
    without one, just after the start, a loss or a jump, it is not sent. VISION_POSITION_ESTIMATE has no velocity. Both
    worlds are x forward, y right, z down from the world's origin.

    Each pose is sent once, when it comes, and nothing without one. A pose is not sent if it is not finite, is no rigid
    motion, is not later than the one before, or shows what was more than `max_age_s` ago by its stamp. `reset_counter`
    goes up by one with the first pose after a loss, a jump, half a second without poses, or `reset`, so that the
    estimator does not take the step for motion. `time_usec` is when the vehicle was there, by this machine's clock,
    which the autopilot may ask for (TIMESYNC). Threads may share it.

    Args:
        connection: A `MavlinkLink`, or the address of one, which is then closed with the sender.
        message: Which message.
        rate_hz: Most messages a second; poses that come sooner are left out. ArduPilot wants 4, PX4 30 to 50.
        max_age_s: Oldest pose in seconds.
        tell: Called with one line when sending stops, why, and when it goes on.

    Attributes:
        sent: Number of messages so far.
        reset_counter: As in the messages, 0 to 255.
        link: The connection.

    Raises:
        StereovoxError: A value is out of range, or as for `MavlinkLink`.
    """

    def __init__(
        self,
        connection: str | MavlinkLink,
        *,
        message: PoseMessage = "odometry",
        rate_hz: float = 30.0,
        max_age_s: float = 0.2,
        tell: Tell = warn,
    ):
        if message not in POSE_MESSAGES:
            raise StereovoxError(f"message {message!r}: give {' or '.join(POSE_MESSAGES)}")
        if not 1 <= rate_hz <= HIGHEST_RATE_HZ:
            raise StereovoxError(f"rate_hz {rate_hz:g}: give 1 to {HIGHEST_RATE_HZ:g} messages a second")
        if not 0 < max_age_s <= 1:
            raise StereovoxError(f"max_age_s {max_age_s:g}: give seconds above 0, at most 1")
        self._message, self._tell = message, tell
        self._period_ns, self._max_age_ns = round(1e9 / rate_hz), max_age_s * 1e9
        self._own = isinstance(connection, str)
        self.link = MavlinkLink(connection, tell=tell) if isinstance(connection, str) else connection
        self._clock = StampClock(self.link.now_ns, "live", epoch_ns, ordered=False)
        self.sent = self.reset_counter = 0
        self._last: tuple[int, Transform] | None = None
        self._due_ns, self._why, self._stepped = -(1 << 62), "", False
        self._lock = threading.Lock()

    def pose(
        self,
        stamp_ns: int,
        T_world_body: ArrayLike,
        covariance: ArrayLike | None = None,
        quality: int = 0,
    ) -> bool:
        """Send a pose.

        Args:
            stamp_ns: When the vehicle was there, in int64 nanoseconds of any clock that runs.
            T_world_body: (4, 4) maps the body (x forward, y left, z up) into the world (z up).
            covariance: (6, 6) of a small rotation about the body (radians), then of its shift (metres), along the
                world's axes, as `Tracked.covariance`; None, or not finite: unknown.
            quality: 1 to 100 per cent, 0 unknown; below 0 the pose counts as lost.

        Returns:
            Whether a message was sent.
        """
        stamp_ns, T, now_ns = int(stamp_ns), np.array(T_world_body, float), self.link.now_ns()
        with self._lock:
            self._clock.heard("poses", stamp_ns, now_ns)
            age_ns = max(self._clock.age_ns(stamp_ns, now_ns), 0)
            if why := self._unusable(stamp_ns, T, age_ns, quality):
                self._lose(why)
                return False
            T[:3, :3] = orthonormalise(T)[:3, :3]
            velocity = self._moved(stamp_ns, T)
            if self._is_early(now_ns) or (self._message == "odometry" and velocity is None):
                return False
            if self._stepped:
                self.reset_counter, self._stepped = (self.reset_counter + 1) % 256, False
            self._due_ns = max(self._due_ns, now_ns - round(EARLY * self._period_ns)) + self._period_ns
            usec = (now_ns - age_ns) // 1000
            done = self.link.send(self._made(usec, T, velocity, covariance, quality))
            self.sent += done
            if self._why:
                self._tell(f"{self.link.url}: poses are sent again")
                self._why = ""
            return done

    def lost(self, why: str) -> None:
        """Send nothing until the next pose: it is not known where the vehicle is. why: in a few words."""
        with self._lock:
            self._lose(why)

    def reset(self) -> None:
        """Say that the next pose continues no motion: the map was corrected, or another one was loaded."""
        with self._lock:
            self._last, self._stepped = None, True

    def close(self) -> None:
        """End, and close the connection if it is this sender's own."""
        if self._own:
            self.link.close()

    def __enter__(self) -> PoseSender:
        """Return itself."""
        return self

    def __exit__(self, *_: Any) -> None:
        """End."""
        self.close()

    def _unusable(self, stamp_ns: int, T: Transform, age_ns: int, quality: int) -> str:
        """Return why a pose cannot be sent, "" if it can."""
        if not (np.abs(T) < FARTHEST_M).all() or rigidity_error(T) > RIGID:
            return "the pose is not known"
        if quality < 0:
            return "its tracker has failed"
        if age_ns > self._max_age_ns:
            return f"the pose is {age_ns / 1e9:.2f} s old, more than {self._max_age_ns / 1e9:g} s"
        if self._last is not None and stamp_ns <= self._last[0]:
            return "its stamp is not later than the one before"
        return ""

    def _is_early(self, now_ns: int) -> bool:
        """Return whether too little time has passed for the next message."""
        left_ns = self._due_ns - now_ns
        return EARLY * self._period_ns < left_ns <= 2 * self._period_ns  # more: the clock was set back

    def _lose(self, why: str) -> None:
        if not self._why:
            self._tell(f"{self.link.url}: no pose is sent: {why}")
        self._why, self._last, self._stepped = why, None, bool(self.sent)

    def _moved(self, stamp_ns: int, T: Transform) -> NDArray[np.float64] | None:
        """Return velocity and turn rate (6,) of the body in its own axes since the last pose; None if not known."""
        last, self._last = self._last, (stamp_ns, T)
        if last is None:
            return None
        seconds = (stamp_ns - last[0]) / 1e9
        shift_m, turn = apart(tuple(last[1][:3].ravel().tolist()), tuple(T[:3].ravel().tolist()))
        if shift_m > STANDS_M + MAX_SPEED_MPS * seconds or turn > STANDS_RAD + np.radians(MAX_TURN_DPS) * seconds:
            self._stepped = True
            return None
        if stamp_ns - last[0] > LONGEST_GAP_NS:
            self._stepped = True  # what sends the poses may have started anew meanwhile
            return None
        R = T[:3, :3]
        return np.concatenate([R.T @ (T[:3, 3] - last[1][:3, 3]), rotation_vector(last[1][:3, :3].T @ R)]) / seconds

    def _made(
        self,
        usec: int,
        T: Transform,
        velocity: NDArray[np.float64] | None,
        covariance: ArrayLike | None,
        quality: int,
    ) -> Any:
        from scipy.spatial.transform import Rotation

        messages, R = self.link.messages, FRD @ T[:3, :3] @ FRD
        x, y, z = (FRD @ T[:3, 3]).tolist()
        angles = atan2(R[2, 1], R[2, 2]), asin(max(-1.0, min(1.0, -R[2, 0]))), atan2(R[1, 0], R[0, 0])
        spread = upper_triangle(covariance, angles)
        if velocity is None or self._message != "odometry":
            return messages.MAVLink_vision_position_estimate_message(usec, x, y, z, *angles, spread, self.reset_counter)
        qx, qy, qz, qw = Rotation.from_matrix(R).as_quat(canonical=True).tolist()
        motion = (velocity.reshape(2, 3) @ FRD).ravel().tolist()
        unknown = [float("nan")] * 21
        return messages.MAVLink_odometry_message(
            usec, LOCAL_FRD, BODY_FRD, x, y, z, [qw, qx, qy, qz], *motion, spread, unknown, self.reset_counter,
            BY_VISION, min(quality, 100),
        )  # fmt: skip


def upper_triangle(covariance: ArrayLike | None, angles: tuple[float, float, float]) -> list[float]:
    """Return the 21 numbers of MAVLink, of x, y, z, roll, pitch and yaw forward, right, down; NaN if not known.

    covariance: as for `PoseSender.pose`. angles: roll, pitch and yaw in radians. Near a pitch of 90 degrees, roll and
    yaw are not determined, so that nothing is known.
    """
    found = np.full((6, 6), np.nan) if covariance is None else np.asarray(covariance, float)
    _, pitch, yaw = angles
    if found.shape != (6, 6) or not (np.abs(found) < WIDEST).all() or abs(cos(pitch)) < STEEPEST:
        return [float("nan")] * 21
    by_rates = np.array(  # a rotation about the world's axes, by small changes of roll, pitch and yaw
        [
            [cos(yaw) * cos(pitch), -sin(yaw), 0.0],
            [sin(yaw) * cos(pitch), cos(yaw), 0.0],
            [-sin(pitch), 0.0, 1.0],
        ]
    )
    change = np.zeros((6, 6))
    change[:3, 3:], change[3:, :3] = FRD, np.linalg.solve(by_rates, FRD)
    return (change @ found @ change.T)[np.triu_indices(6)].tolist()


KEPT = 64
"""Number of latest poses kept."""
SHORTEST_NS, LONGEST_NS = 40_000_000, 300_000_000
"""Time between the two poses that give the motion: less is noise; over more, the motion has changed."""
SLACK_M, SLACK_RAD = 0.05, np.radians(2)
"""Motion that is never a jump, as for the map's gate."""


class BodyPose(NamedTuple):
    """A pose of a body, its time and its arrival, in nanoseconds. T_world_body: (4, 4), body in optical axes."""

    stamp_ns: int
    came_ns: int
    T_world_body: Transform


class Body:
    """The last poses of a body, in order of their stamps. Threads may share it.

    Attributes:
        jumped_ns: Stamp of the last pose out of the body's reach from the one before; None: there was none.
    """

    def __init__(self) -> None:
        self._poses: deque[BodyPose] = deque(maxlen=KEPT)
        self._lock = MapLock()
        self.jumped_ns: int | None = None

    def take(self, pose: BodyPose) -> None:
        """Add a pose, unless there is a newer one; of two with one stamp the later one counts."""
        with self._lock:
            if self._poses and pose.stamp_ns < self._poses[-1].stamp_ns:
                if self._poses[-1].stamp_ns - pose.stamp_ns <= RESET_NS:
                    return
                self._poses.clear()  # the clock was set back
                self.jumped_ns = pose.stamp_ns
            if self._poses and not _in_reach(self._poses[-1], pose):
                self._poses.clear()  # do not extrapolate across a jump
                self.jumped_ns = pose.stamp_ns
            if self._poses and self._poses[-1].stamp_ns == pose.stamp_ns:
                self._poses.pop()
            self._poses.append(pose)

    @property
    def newest(self) -> BodyPose | None:
        """The newest pose."""
        with self._lock:
            return self._poses[-1] if self._poses else None

    def after(self, ahead_ns: int) -> Transform | None:
        """Return T_world_body (4, 4) extrapolated by `ahead_ns` from the newest pose; None without any.

        It is extrapolated by at most LONGEST_NS, and not at all if only one pose is known.
        """
        with self._lock:
            if not self._poses:
                return None
            then, before = self._poses[-1], None
            for pose in reversed(self._poses):
                if then.stamp_ns - pose.stamp_ns >= SHORTEST_NS:
                    before = pose
                    break
        if before is None or ahead_ns <= 0 or then.stamp_ns - before.stamp_ns > LONGEST_NS:
            return then.T_world_body
        share = min(ahead_ns, LONGEST_NS) / (then.stamp_ns - before.stamp_ns)
        return interpolate(before.T_world_body, then.T_world_body, 1 + share)


def _in_reach(before: BodyPose, now: BodyPose) -> bool:
    """Return whether a body can have moved from one pose to the next."""
    metres, angle = apart(*(tuple(one.T_world_body[:3].ravel().tolist()) for one in (before, now)))
    seconds = (now.stamp_ns - before.stamp_ns) / 1e9
    reach = MAX_SPEED_MPS * seconds + SLACK_M, np.radians(MAX_TURN_DPS) * seconds + SLACK_RAD
    return seconds == 0 or (metres <= reach[0] and angle <= reach[1])
