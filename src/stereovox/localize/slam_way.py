# SPDX-License-Identifier: Apache-2.0
"""The robot's way as SLAM keeps it: scans' places as seen from keyframes, so that they move along with the graph."""

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
        self._begun = False
        self._late, self._late_ns, self._against = 0, 0, 0

    def room(self, stamp_ns: int) -> int | None:
        """Make room for a scan at `stamp_ns`; return how many earlier ones gave way, None where it is itself too late.

        A lone stamp in the future would make all later scans too late. So once more scans in a row are late than there
        were steps later than the first of them, those steps have the wrong stamps, and go.
        """
        ahead = len(self._steps) - bisect_left(self._steps, stamp_ns, key=lambda step: step.stamp_ns)
        if not ahead:
            self._late = 0
            return 0
        if not self._late or stamp_ns <= self._late_ns:
            self._late, self._against = 0, ahead
        self._late, self._late_ns = self._late + 1, stamp_ns
        if self._late <= max(self._against, LATE):
            return None
        del self._steps[-ahead:]
        self._late = 0
        return ahead

    def add(self, scan: Scan, pose: planar.Pose, keyframes: list[Keyframe]) -> None:
        """Take a scan that there is room for, and where (3,) the robot stood.

        What comes before there is a keyframe is kept as seen from the first one.
        """
        if keyframes and not self._begun:
            self._begun = True
            self._steps = [replace(s, since=planar.relative(keyframes[0].pose, s.since)) for s in self._steps]
        since = planar.relative(keyframes[-1].pose, pose) if keyframes else pose
        self._steps.append(Step(scan.stamp_ns, scan.pose_world_base, max(len(keyframes) - 1, 0), since))

    def track(self, keyframes: list[Keyframe]) -> Track:
        """Return the way, with the keyframes where they stand now."""
        anchors = np.array([keyframes[step.keyframe].pose for step in self._steps])
        poses = planar.compose(anchors, np.array([step.since for step in self._steps]))
        corrections = planar.compose(poses, planar.inverse(np.array([step.odometry for step in self._steps])))
        return Track(np.array([step.stamp_ns for step in self._steps], np.int64), poses, corrections)
