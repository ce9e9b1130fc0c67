# SPDX-License-Identifier: Apache-2.0
"""The current pose of a body: its newest pose, extrapolated by its last motion."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from stereovox.frame.stamp_clock import RESET_NS
from stereovox.geometry.se3 import Transform, apart, interpolate
from stereovox.kernels.threads import MapLock
from stereovox.sources.poses.live_poses import MAX_SPEED_MPS, MAX_TURN_DPS

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
