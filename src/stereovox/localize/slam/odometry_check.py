# SPDX-License-Identifier: Apache-2.0
"""Whether matching and odometry agree, and which of them to trust if they do not.

One step says little: clocks differ, wheels jolt. So both motions are compared over the last metre, and their usual
difference is learned from the drive itself.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry import se2
from stereovox.localize.slam.line_map import Cloud

COMPARED_PATH, COMPARED_SCANS = 1.0, 20
"""Metres of odometry, and most scans, over which the two motions are compared."""
MIN_LIMIT, MIN_LIMIT_TURN = 0.25, 0.2
"""Lower bounds, in metres and radians, of the limits on their difference."""
MAX_LIMIT, MAX_LIMIT_TURN = 0.4, 0.35
"""Upper bounds of those limits, however bad the odometry is."""
LIMIT_FACTOR, LEARNING_RATE = 6.0, 0.01
"""The limits as multiples of the usual difference; weight of one scan in the usual difference."""
SLIPPED_SCALE, STUCK_SCALE, SCALED_SCANS = 2.0, 0.25, 10
"""Factors on the odometry's errors after wheels slipped, and after matching stuck; number of scans they last."""
SHARE_MARGIN, SHARE_MARGIN_SLIPPING = 0.25, 0.05
"""Share of a scan's points by which the matched pose must fit better than the odometry's to be accepted: usually, and
while wheels slip."""
STILL = 1e-3
"""Metres and radians of a step below which the robot stands still."""
MIN_BEHIND = 0.3
"""Metres behind a wall at which a beam must end to contradict it."""


@dataclass(frozen=True)
class Moment:
    """The robot's pose at one scan by odometry and by matching, (3,) each in its own frame; metres travelled."""

    odometry: se2.Pose
    matched: se2.Pose
    travelled: float


class OdometryCheck:
    """Compares odometry with matching.

    scale: factor on the odometry's errors, 1 while both agree.
    """

    def __init__(self) -> None:
        self._past: deque[Moment] = deque(maxlen=COMPARED_SCANS)
        self._usual = np.array([MIN_LIMIT, MIN_LIMIT_TURN]) / LIMIT_FACTOR
        self._scale, self._left = 1.0, 0

    @property
    def scale(self) -> float:
        """The factor for the next scan."""
        return self._scale if self._left else 1.0

    @property
    def margin(self) -> float:
        """The share by which the matched pose must fit better."""
        return SHARE_MARGIN_SLIPPING if self.scale > 1 else SHARE_MARGIN

    def add(self, odometry: se2.Pose, before: se2.Pose, after: se2.Pose) -> Moment | None:
        """Take the odometry (3,) at a scan whose match moved the robot from `before` to `after`, (3,) each.

        Return the moment since which they contradict each other, None if they agree.
        """
        self._left = max(self._left - 1, 0)
        if not self._past:
            self._past.append(Moment(odometry, after, 0.0))
            return None
        last = self._past[-1]
        travelled = last.travelled + float(np.hypot(*(odometry - last.odometry)[:2]))
        matched = se2.compose(last.matched, se2.relative(before, after))
        self._past.append(Moment(odometry, matched, travelled))
        past = list(self._past)[:-1]
        since = next((moment for moment in past if moment.travelled > travelled - COMPARED_PATH), past[-1])
        apart = np.array(self._difference(since))
        limits = np.clip(LIMIT_FACTOR * self._usual, (MIN_LIMIT, MIN_LIMIT_TURN), (MAX_LIMIT, MAX_LIMIT_TURN))
        self._usual += LEARNING_RATE * (np.minimum(apart, 3 * self._usual) - self._usual)
        return since if (apart > limits).any() else None

    def drift(self, step: se2.Pose) -> tuple[float, float]:
        """Return the usual difference, in metres and radians, of odometry and matching over a step (3,)."""
        metres, radians = float(np.hypot(step[0], step[1])), abs(float(step[2]))
        moved = metres + radians > STILL
        share = max(metres / COMPARED_PATH, moved / COMPARED_SCANS)
        return share * float(self._usual[0]), share * float(self._usual[1])

    def restart(self, odometry: se2.Pose, pose: se2.Pose) -> None:
        """Restart the comparison after an unmatched scan, at the odometry (3,) and the pose (3,) it led to."""
        self._past.clear()
        self._past.append(Moment(odometry, pose, 0.0))

    def settle(self, scale: float) -> None:
        """Restart the comparison at the last scan; the odometry's errors are scaled by `scale` for a while."""
        last = self._past[-1]
        self._past.clear()
        self._past.append(last)
        self._scale, self._left = scale, SCALED_SCANS

    def by_odometry(self, since: Moment, pose: se2.Pose) -> se2.Pose:
        """Return the odometry's pose, since a moment, of the robot matched to `pose` (3,)."""
        last = self._past[-1]
        there = se2.compose(pose, se2.relative(last.matched, since.matched))
        return se2.compose(there, se2.relative(since.odometry, last.odometry))

    def _difference(self, since: Moment) -> tuple[float, float]:
        last = self._past[-1]
        left = se2.relative(se2.relative(since.matched, last.matched), se2.relative(since.odometry, last.odometry))
        return float(np.hypot(left[0], left[1])), abs(float(left[2]))


def through(seen: Cloud, points: NDArray[np.floating], bins: int = 720) -> tuple[int, int]:
    """Count how many of other points a scan sees through, and how many it could see.

    seen: the scan, in the robot's frame; points: (N, 2) there. A point counts if the scan has a beam within a degree;
    it is seen through if that beam and those on both sides of it end `MIN_BEHIND` metres or more behind the point.
    """

    def polar(p: NDArray[np.floating]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        turn = np.arctan2(p[:, 1], p[:, 0])
        return np.floor((turn + np.pi) * (bins / (2 * np.pi))).astype(np.int64) % bins, np.hypot(*p.T)

    at, away = polar(seen.points)
    nearest = np.full(bins, np.inf)
    np.minimum.at(nearest, at, away)
    around = np.minimum(nearest, np.minimum(np.roll(nearest, 1), np.roll(nearest, -1)))
    there, distance = polar(points)
    reach = around[there]
    known = np.isfinite(reach)
    return int(np.sum(known & (distance < reach - MIN_BEHIND))), int(np.sum(known & (distance < reach + MIN_BEHIND)))
