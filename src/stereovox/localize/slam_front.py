# SPDX-License-Identifier: Apache-2.0
"""Follows the robot from scan to scan: each is laid onto the map of the last keyframes."""

from __future__ import annotations

import numpy as np

from stereovox import planar
from stereovox.config_robot import SlamConfig
from stereovox.frame import Scan
from stereovox.localize.line_map import Cloud, LineMap, cloud_of, joined
from stereovox.localize.slam_keyframe import Keyframe

STEP_YAW = 0.01
"""Radians between the turns that the search tries."""
FEWEST = 10
"""Hits below which a scan is not matched: its pose is the odometry's."""


class Follower:
    """Gives each scan its pose, and picks keyframes.

    keyframes: those so far; their poses may be changed from outside, then call `moved`.
    pose: (3,) pose_map_base of the last scan.
    """

    def __init__(self, config: SlamConfig):
        self.keyframes: list[Keyframe] = []
        self.pose: planar.Pose = np.zeros(3)
        self._config = config
        self._map = LineMap(config.voxel_size)
        self._odometry: planar.Pose | None = None
        self._travelled = 0.0

    def add(self, scan: Scan) -> bool:
        """Find the pose of the next scan; tell whether it became a keyframe."""
        odometry, cloud = scan.pose_world_base, cloud_of(scan, self._config.max_range)
        if self._odometry is None:
            self.pose = odometry
        else:
            step = planar.relative(self._odometry, odometry)
            before, self.pose = self.pose, self._matched(cloud, planar.compose(self.pose, step), step)
            self._travelled += float(np.hypot(*(self.pose - before)[:2]))
        self._odometry = odometry
        if not self._is_new(cloud):
            return False
        step = planar.relative(self.keyframes[-1].pose, self.pose) if self.keyframes else np.zeros(3)
        self.keyframes.append(Keyframe(self.pose, step, cloud, scan, self._travelled))
        self._rebuild()
        return True

    def moved(self, keyframe_before: planar.Pose) -> None:
        """Go on from where the last keyframe now stands; it stood at `keyframe_before` (3,)."""
        self.pose = planar.compose(self.keyframes[-1].pose, planar.relative(keyframe_before, self.pose))
        self._rebuild()

    def _matched(self, cloud: Cloud, guess: planar.Pose, step: planar.Pose) -> planar.Pose:
        if len(cloud.points) < FEWEST or not self.keyframes:
            return guess
        config = self._config
        metres, radians = odometry_sigmas(config, step)
        information = np.diag([metres**-2, metres**-2, radians**-2])
        start, _ = self._map.search(
            cloud, guess, metres, 2 * radians, STEP_YAW, 0.005 / metres**2, 0.005 / radians**2,
        )  # fmt: skip
        start = self._map.refine(cloud, start, 2 * config.sigma, guess, information).pose
        return self._map.refine(cloud, start, config.sigma, guess, information).pose

    def _is_new(self, cloud: Cloud) -> bool:
        if not self.keyframes:
            return len(cloud.points) >= FEWEST
        way = planar.relative(self.keyframes[-1].pose, self.pose)
        far = np.hypot(way[0], way[1]) > self._config.keyframe_distance or abs(way[2]) > self._config.keyframe_turn
        return bool(far) and len(cloud.points) >= FEWEST

    def _rebuild(self) -> None:
        recent = self.keyframes[-self._config.local_keyframes :]
        here = np.append(np.floor(recent[-1].pose[:2]), 0.0)  # float32 points stay exact far from the world's origin
        self._map.build(joined([keyframe.cloud.moved(keyframe.pose - here) for keyframe in recent]), here[:2])


def odometry_sigmas(config: SlamConfig, step: planar.Pose) -> tuple[float, float]:
    """Return by how many metres and radians (standard deviations) a step (3,) of the odometry may be off."""
    base, per_metre, base_turn, per_radian = config.odometry
    return base + per_metre * float(np.hypot(step[0], step[1])), base_turn + per_radian * abs(float(step[2]))
