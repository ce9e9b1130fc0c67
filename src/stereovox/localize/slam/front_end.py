# SPDX-License-Identifier: Apache-2.0
"""SLAM front end: matches each scan against the map of the last keyframes."""

from __future__ import annotations

import numpy as np

from stereovox.config.robot import SlamConfig
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.slam.graph import (
    SLACK_TURN,
    SLIPPED_SCALE,
    STUCK_SCALE,
    Keyframe,
    Moment,
    OdometryCheck,
    through,
)
from stereovox.localize.slam.line_map import Cloud, LineMap, Match, cloud_of, joined
from stereovox.localize.slam.loops import ClosureSearch

STEP_YAW = 0.01
"""Radians between the yaw angles that the search tries."""
MAX_WINDOW, MAX_WINDOW_TURN = 1.0, 1.5
"""Largest search window in metres and radians, whatever the odometry reports."""
MIN_WINDOW = 0.1
"""Smallest search window in metres."""
SLOPE = 0.02
"""Likelihood penalty of the search at one standard deviation of the odometry. Along a corridor, far points fall between
the earlier ones, so a scan that moves on loses this much against one that stays."""
PRIOR_FACTOR = 2.0
"""Factor on the odometry's errors in refinement, relative to the search: walls, if any, are more accurate."""
SEARCH_POINTS = 100
"""Approximate number of points for the search, which need only get close."""
MIN_HITS = 10
"""Hits below which a scan is not matched: it takes the odometry's pose."""
MIN_NEAR_POINTS = 3
"""Map points needed near a scan point: along a corridor, isolated far points repeat with the beams and would hold every
scan in place."""
LOST_SHARE, FOUND_SHARE = 0.5, 0.6
"""Share of a scan's points on the map below which a match is rejected, and above which a wide search's is accepted."""
MIN_BACK = 0.05
"""Metres of a step above which the reverse direction is also tried."""
BACK_MARGIN, BACK_MARGIN_SEEN = 0.05, 0.15
"""Share of a scan's points by which it must fit better in reverse: points on walls alone, and minus the share of walls
seen through."""
MIN_LOST_STEP, MAX_LOST_PATH = 0.05, 0.5
"""Least metres a lost scan counts, and metres lost after which the map continues by odometry."""
MAX_WIDE_WINDOW = 3.0
"""Largest half width in metres of the wide search."""
FIT_SIGMAS = (0.05, 0.03)
"""Metres and radians (standard deviations) around a pose within which its fit is measured."""


class Follower:
    """Finds each scan's pose, and picks keyframes.

    keyframes: all so far; after changing their poses from outside, call `moved`.
    pose: (3,) pose_map_base of the last scan.
    """

    def __init__(self, config: SlamConfig):
        self.keyframes: list[Keyframe] = []
        self.pose: se2.Pose = np.zeros(3)
        self._config = config
        self._map = LineMap(config.voxel_size, reach=0.2, fewest=MIN_NEAR_POINTS)
        self._odometry: se2.Pose | None = None
        self._travelled = 0.0
        self._start: se2.Pose = np.zeros(3)
        self._moved: dict[int, Cloud] = {}
        self._check = OdometryCheck()
        self._held, self._lost, self._was_lost, self._blind = 0.0, 0.0, 0.0, 0.0
        self._backed = False
        self._wide = ClosureSearch(config)

    def add(self, scan: Scan) -> bool:
        """Find the pose of the next scan; return whether it became a keyframe."""
        odometry, cloud = scan.pose_world_base, cloud_of(scan, self._config.max_range)
        if self._odometry is None:
            self.pose = odometry
            self._start[:2] = np.floor(odometry[:2])  # float32 points stay exact far from the world's origin
        else:
            step = se2.relative(self._odometry, odometry)
            before, self.pose = self.pose, self._found(cloud, se2.compose(self.pose, step), step)
            self._compare(cloud, odometry, before, step)
            self._travelled += float(np.hypot(*(self.pose - before)[:2]))
        self._odometry = odometry
        if not self._is_new(cloud):
            return False
        self._append(cloud, scan)
        self._rebuild()
        return True

    def moved(self, keyframe_before: se2.Pose) -> None:
        """Continue from the last keyframe's new pose; the old one was `keyframe_before` (3,)."""
        self.pose = se2.compose(self.keyframes[-1].pose, se2.relative(keyframe_before, self.pose))
        self._moved.clear()
        self._rebuild()

    def _append(self, cloud: Cloud, scan: Scan) -> None:
        """Make a keyframe of a scan."""
        step = se2.relative(self.keyframes[-1].pose, self.pose) if self.keyframes else np.zeros(3)
        slack = max(self._held, self._was_lost, self._lost + self._blind)
        self.keyframes.append(Keyframe(self.pose, step, cloud, scan, self._travelled, slack, slack > self._held))
        self._held, self._was_lost, self._blind = 0.0, self._lost, 0.0

    def _found(self, cloud: Cloud, guess: se2.Pose, step: se2.Pose) -> se2.Pose:
        """Return a scan's pose: by matching, else by a wide search, else by the odometry, with slack."""
        self._backed = False
        if len(cloud.points) < MIN_HITS or not self.keyframes:
            return guess
        match = self._forth_or_back(cloud, guess, step)
        sigmas = odometry_sigmas(self._config, step)
        if match.share >= LOST_SHARE or (not self._lost and _agree(match.pose, guess, sigmas)):
            self._lost = 0.0
            return match.pose
        self._lost += max(float(np.hypot(step[0], step[1])), MIN_LOST_STEP)
        side = min(MAX_WINDOW / 2 + 2 * self._lost, MAX_WIDE_WINDOW)
        self._wide.set_target(joined(list(self._moved.values())))
        found = self._wide.match(
            cloud, guess - self._start, side, min(MAX_WINDOW_TURN / 3 + abs(float(step[2])), MAX_WINDOW_TURN)
        )
        if found is not None and found.share >= FOUND_SHARE:
            self._lost = 0.0
            return self._map.refine(cloud, found.pose + self._start, self._config.sigma).pose
        return guess

    def _forth_or_back(self, cloud: Cloud, guess: se2.Pose, step: se2.Pose) -> Match:
        """Match near the odometry's `guess`; or in reverse, in case wheels turned the wrong way or a robot was pushed.

        Reverse must fit far better, by points on walls and by walls seen through: the area ahead is new, so every scan
        seems to fit better a step behind.
        """
        match, metres = self._matched(cloud, guess, step), float(np.hypot(step[0], step[1]))
        if metres < MIN_BACK or match.share > 1 - BACK_MARGIN:
            return match
        back = self._matched(cloud, se2.compose(self.pose, [-step[0], -step[1], step[2]]), step)
        if back.share < match.share + BACK_MARGIN:
            return match
        self._backed = self._fit(cloud, back.pose)[1] > self._fit(cloud, match.pose)[1] + BACK_MARGIN_SEEN
        return back if self._backed else match

    def _compare(self, cloud: Cloud, odometry: se2.Pose, before: se2.Pose, step: se2.Pose) -> None:
        """Compare the motion just matched, from `before` (3,), with the odometry's."""
        if len(cloud.points) < MIN_HITS:
            metres, radians = self._check.drift(step)
            self._blind += max(metres, radians / SLACK_TURN)
            self._check.restart(odometry, self.pose)
            return
        since = self._check.add(odometry, before, self.pose)
        if self._backed:
            self._check.settle(SLIPPED_SCALE)
        elif since is not None and self.keyframes:
            self._judge(cloud, since)

    def _judge(self, cloud: Cloud, since: Moment) -> None:
        """Choose matching or odometry since the moment at which they began to contradict each other."""
        guess = self._check.by_odometry(since, self.pose)
        (pose, matched), (other, driven) = self._fit(cloud, self.pose), self._fit(cloud, guess)
        if _nearer(other, pose, guess) or matched > driven + self._check.margin:
            self._check.settle(SLIPPED_SCALE)
            return
        left = se2.relative(self.pose, guess)
        slack = max(float(np.hypot(left[0], left[1])), abs(float(left[2])) / SLACK_TURN) + FIT_SIGMAS[0]
        self.pose, self._held = guess, max(self._held, slack)
        self._check.settle(STUCK_SCALE)

    def _fit(self, cloud: Cloud, pose: se2.Pose) -> tuple[se2.Pose, float]:
        """Return the best pose near `pose`, and the share of points on the map there, less those seen through."""
        held = np.diag([FIT_SIGMAS[0] ** -2, FIT_SIGMAS[0] ** -2, FIT_SIGMAS[1] ** -2])
        match = self._map.refine(cloud, pose, self._config.sigma, pose, held)
        known = joined(list(self._moved.values())).points + self._start[:2]
        crossed, met = through(cloud, se2.transform(se2.inverse(match.pose), known))
        return match.pose, match.share - crossed / max(met, 1)

    def _matched(self, cloud: Cloud, guess: se2.Pose, step: se2.Pose) -> Match:
        config = self._config
        metres, radians = odometry_sigmas(config, step)
        metres *= self._check.scale
        information = np.diag([metres**-2, metres**-2, radians**-2]) / PRIOR_FACTOR**2
        seeds = cloud.points[:: max(len(cloud.points) // SEARCH_POINTS, 1)]
        slopes = SLOPE / metres**2, SLOPE / radians**2
        window = min(max(3 * metres, MIN_WINDOW), MAX_WINDOW), min(2 * radians, MAX_WINDOW_TURN)
        start, _ = self._map.search(seeds, guess, *window, STEP_YAW, *slopes)
        start = self._map.refine(cloud, start, 2 * config.sigma, guess, information).pose
        return self._map.refine(cloud, start, config.sigma, guess, information)

    def _is_new(self, cloud: Cloud) -> bool:
        if not self.keyframes:
            return len(cloud.points) >= MIN_HITS
        if 0 < self._lost < MAX_LOST_PATH or len(cloud.points) < MIN_HITS:
            return False
        way = se2.relative(self.keyframes[-1].pose, self.pose)
        far = np.hypot(way[0], way[1]) > self._config.keyframe_distance or abs(way[2]) > self._config.keyframe_turn
        return bool(far)

    def _rebuild(self) -> None:
        """Build the map of the last keyframes; clouds in the map's frame are reused until poses change."""
        known = self._moved  # by keyframe index: if the robot turns back, old ones are in range again
        self._moved = {i: known[i] if i in known else self._in_map(self.keyframes[i]) for i in self._recent()}
        self._map.build(joined(list(self._moved.values())), self._start[:2])

    def _in_map(self, keyframe: Keyframe) -> Cloud:
        return keyframe.cloud.moved(keyframe.pose - self._start)

    def _recent(self) -> range:
        """The last keyframes, back to where the view no longer overlaps; if odometry jumps, all starts anew."""
        here, count = self.keyframes[-1].pose, len(self.keyframes)
        first = max(count - self._config.local_keyframes, 0)
        far = [np.hypot(*(k.pose - here)[:2]) > self._config.max_range for k in self.keyframes[first:]]
        return range(max((first + i + 1 for i, away in enumerate(far) if away), default=first), count)


def odometry_sigmas(config: SlamConfig, step: se2.Pose) -> tuple[float, float]:
    """Return the standard deviations, in metres and radians, of an odometry step (3,)."""
    base, per_metre, base_turn, per_radian = config.odometry
    return base + per_metre * float(np.hypot(step[0], step[1])), base_turn + per_radian * abs(float(step[2]))


def _agree(pose: se2.Pose, guess: se2.Pose, sigmas: tuple[float, float]) -> bool:
    """Return whether a match agrees with the odometry: then a scan that fits few walls is seeing new ones."""
    left = se2.relative(guess, pose)
    return float(np.hypot(left[0], left[1])) < sigmas[0] and abs(float(left[2])) < sigmas[1]


def _nearer(pose: se2.Pose, one: se2.Pose, other: se2.Pose) -> bool:
    """Return whether a pose is nearer to one than to the other, with a radian as a metre."""
    a, b = (se2.relative(pose, goal) for goal in (one, other))
    return float(np.linalg.norm(a)) < float(np.linalg.norm(b))
