# SPDX-License-Identifier: Apache-2.0
"""SLAM front end: matches each scan against the map of the last keyframes."""

from __future__ import annotations

import numpy as np

from stereovox import se2
from stereovox.config.robot import SlamConfig
from stereovox.frame import Scan
from stereovox.localize.slam.graph import Keyframe
from stereovox.localize.slam.line_map import Cloud, LineMap, cloud_of, joined

STEP_YAW = 0.01
"""Radians between the turns that the search tries."""
WINDOW, WINDOW_TURN = 1.0, 1.5
"""Metres and radians that are searched at most, whatever the odometry says."""
MIN_WINDOW = 0.1
SLOPE = 0.02
"""Likelihood that the search takes off at one standard deviation of the odometry: so much a scan that moves on along a
corridor loses against one that stays where it was, as its far points fall between those of before."""
LOOSER = 2.0
"""By how much the last step trusts the odometry less than the search: walls know better where there are any."""
SEARCHED = 100
"""Points that the search looks at: it need only come near."""
FEWEST = 10
"""Hits below which a scan is not matched: its pose is the odometry's."""


class Follower:
    """Gives each scan its pose, and picks keyframes.

    keyframes: those so far; their poses may be changed from outside, then call `moved`.
    pose: (3,) pose_map_base of the last scan.
    """

    def __init__(self, config: SlamConfig):
        self.keyframes: list[Keyframe] = []
        self.pose: se2.Pose = np.zeros(3)
        self._config = config
        self._map = LineMap(config.voxel_size, reach=0.2)
        self._odometry: se2.Pose | None = None
        self._travelled = 0.0
        self._start: se2.Pose = np.zeros(3)
        self._moved: dict[int, Cloud] = {}

    def add(self, scan: Scan) -> bool:
        """Find the pose of the next scan; return whether it became a keyframe."""
        odometry, cloud = scan.pose_world_base, cloud_of(scan, self._config.max_range)
        if self._odometry is None:
            self.pose = odometry
            self._start[:2] = np.floor(odometry[:2])  # float32 points stay exact far from the world's origin
        else:
            step = se2.relative(self._odometry, odometry)
            before, self.pose = self.pose, self._matched(cloud, se2.compose(self.pose, step), step)
            self._travelled += float(np.hypot(*(self.pose - before)[:2]))
        self._odometry = odometry
        if not self._is_new(cloud):
            return False
        step = se2.relative(self.keyframes[-1].pose, self.pose) if self.keyframes else np.zeros(3)
        self.keyframes.append(Keyframe(self.pose, step, cloud, scan, self._travelled))
        self._rebuild()
        return True

    def moved(self, keyframe_before: se2.Pose) -> None:
        """Continue from the last keyframe's new pose; it was at `keyframe_before` (3,)."""
        self.pose = se2.compose(self.keyframes[-1].pose, se2.relative(keyframe_before, self.pose))
        self._moved.clear()
        self._rebuild()

    def _matched(self, cloud: Cloud, guess: se2.Pose, step: se2.Pose) -> se2.Pose:
        if len(cloud.points) < FEWEST or not self.keyframes:
            return guess
        config = self._config
        metres, radians = odometry_sigmas(config, step)
        information = np.diag([metres**-2, metres**-2, radians**-2]) / LOOSER**2
        seeds = cloud.points[:: max(len(cloud.points) // SEARCHED, 1)]
        slopes = SLOPE / metres**2, SLOPE / radians**2
        window = min(max(3 * metres, MIN_WINDOW), WINDOW), min(2 * radians, WINDOW_TURN)
        start, _ = self._map.search(seeds, guess, *window, STEP_YAW, *slopes)
        start = self._map.refine(cloud, start, 2 * config.sigma, guess, information).pose
        return self._map.refine(cloud, start, config.sigma, guess, information).pose

    def _is_new(self, cloud: Cloud) -> bool:
        if not self.keyframes:
            return len(cloud.points) >= FEWEST
        way = se2.relative(self.keyframes[-1].pose, self.pose)
        far = np.hypot(way[0], way[1]) > self._config.keyframe_distance or abs(way[2]) > self._config.keyframe_turn
        return bool(far) and len(cloud.points) >= FEWEST

    def _rebuild(self) -> None:
        """Make the map of the last keyframes; clouds that are in the map's frame stay so until poses change."""
        known = self._moved  # by the keyframe's number: where the robot turns back, old ones come within reach again
        self._moved = {i: known[i] if i in known else self._in_map(self.keyframes[i]) for i in self._recent()}
        self._map.build(joined(list(self._moved.values())), self._start[:2])

    def _in_map(self, keyframe: Keyframe) -> Cloud:
        return keyframe.cloud.moved(keyframe.pose - self._start)

    def _recent(self) -> range:
        """The last keyframes, back to where the robot was out of sight: where odometry jumps, all starts anew."""
        here, count = self.keyframes[-1].pose, len(self.keyframes)
        first = max(count - self._config.local_keyframes, 0)
        far = [np.hypot(*(k.pose - here)[:2]) > self._config.max_range for k in self.keyframes[first:]]
        return range(max((first + i + 1 for i, away in enumerate(far) if away), default=first), count)


def odometry_sigmas(config: SlamConfig, step: se2.Pose) -> tuple[float, float]:
    """Return by how many metres and radians (standard deviations) a step (3,) of the odometry may be off."""
    base, per_metre, base_turn, per_radian = config.odometry
    return base + per_metre * float(np.hypot(step[0], step[1])), base_turn + per_radian * abs(float(step[2]))
