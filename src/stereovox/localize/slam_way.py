# SPDX-License-Identifier: Apache-2.0
"""The robot's way as SLAM keeps it: each scan's place as seen from a keyframe, so that it moves along with the graph."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, replace

import numpy as np

from stereovox import planar
from stereovox.frame import Scan
from stereovox.localize.slam_keyframe import Keyframe
from stereovox.localize.track import Track

LATE = 3
"""Scans in a row that are too late, and in order among themselves, before it is asked who is right."""


@dataclass(frozen=True, eq=False)
class Step:
    """A scan: where the odometry saw the robot (3,), and where it stood (3,) as seen from keyframe `keyframe`."""

    stamp_ns: int
    odometry: planar.Pose
    keyframe: int
    since: planar.Pose


class Way:
    """The steps so far, stamps rising."""

    def __init__(self) -> None:
        self._steps: list[Step] = []
        self._early: list[tuple[Scan, planar.Pose]] = []
        self._late, self._late_ns = 0, 0

    def room(self, stamp_ns: int) -> int | None:
        """Make room for a scan at `stamp_ns`; return how many earlier ones gave way, None where it is itself too late.

        A lone stamp in the future would make all later scans too late. So once more scans in a row are late than there
        are steps that they would have to come before, the steps have the wrong stamps, and go.
        """
        ahead = len(self._steps) - bisect_left(self._steps, stamp_ns, key=lambda step: step.stamp_ns)
        if not ahead:
            self._late = 0
            return 0
        self._late = self._late + 1 if self._late and stamp_ns > self._late_ns else 1
        self._late_ns = stamp_ns
        if self._late <= max(ahead, LATE):
            return None
        del self._steps[-ahead:]
        self._late = 0
        return ahead

    def add(self, scan: Scan, pose: planar.Pose, keyframes: list[Keyframe]) -> None:
        """Take a scan that there is room for, and where (3,) the robot stood, in the frame of the keyframes of now.

        Before there is a keyframe, the first one to come is what it is seen from.
        """
        at = max(len(keyframes) - 1, 0)
        self._steps.append(Step(scan.stamp_ns, scan.pose_world_base, at, pose))
        if not keyframes:
            self._unseen += 1
        ...

    def track(self, keyframes: list[Keyframe]) -> Track:
        """Return the way with the keyframes where they are now."""
