# SPDX-License-Identifier: Apache-2.0
"""Where a body is now: its newest pose, carried on by its last motion for as long as that pose is old."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from stereovox.frame.stamp_clock import RESET_NS
from stereovox.geometry.se3 import Transform, apart, interpolate
from stereovox.kernels.threads import MapLock
from stereovox.sources.poses.live_poses import MAX_SPEED_MPS, MAX_TURN_DPS

KEPT = 64
"""Last poses that are kept."""
SHORTEST_NS, LONGEST_NS = 40_000_000, 300_000_000
"""Between the two poses that tell the motion: in less, noise would; over more, the motion has changed."""
SLACK_M, SLACK_RAD = 0.05, np.radians(2)
"""What is never a jump, as for the map's gate."""


class BodyPose(NamedTuple):
    """A pose of a body and when it came, in nanoseconds. T_world_body: (4, 4), body in optical axes."""

    stamp_ns: int
    came_ns: int
    T_world_body: Transform


class Body:
    """The last poses of a body, in order of their stamps. Threads may share it.

    Attributes:
        jumped_ns: Stamp of the last pose that the body cannot have reached from the one before; None: all are in reach.
    """

    def __init__(self) -> None:
        self._poses: deque[BodyPose] = deque(maxlen=KEPT)
        self._lock = MapLock()
        self.jumped_ns: int | None = None

    def take(self, pose: BodyPose) -> None:
        """Take in a pose, unless a newer one is there; of two with one stamp the later one counts."""
        with self._lock:
            if self._poses and pose.stamp_ns < self._poses[-1].stamp_ns:
                if self._poses[-1].stamp_ns - pose.stamp_ns <= RESET_NS:
                    return
                self._poses.clear()  # the clock was set back
                self.jumped_ns = pose.stamp_ns
            if self._poses and not _in_reach(self._poses[-1], pose):
                self._poses.clear()  # no motion leads across a jump
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
        """Return T_world_body (4, 4) so long after the newest pose, if the body moved on as before; None without any.

        It is not carried on by more than LONGEST_NS, and stands still where only one pose is known.
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
