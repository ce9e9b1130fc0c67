# SPDX-License-Identifier: Apache-2.0
"""Relative poses of keyframes for the pose graph: steps, and the last refinement.

Whether matching and odometry agree, and which of them to trust if they do not.

One step says little: clocks differ, wheels jolt. So both motions are compared over the last metre, and their usual
difference is learned from the drive itself.

A finished map's self-check against its own scans.

The limits were chosen on seeds 0 to 99 of `benchmarks/slam_drives.py` and on the logs ACES, MIT-CSAIL and fr079.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config.robot import SlamConfig
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.geometry.pose_graph import Edge
from stereovox.localize.slam.line_map import Cloud, LineMap, joined

STEP_SIGMA = (0.01, 0.03, 0.003, 0.02)
"""Standard deviation of a matched step between keyframes: metres, per metre, radians, per radian."""
SLACK_TURN = 0.3
"""Radians per metre of slack."""
PATCH = 4
"""Keyframes of a patch before and after its middle: few enough to be rigid."""
STRIDE = 3
"""Keyframes from one patch's middle to the next."""
WEAK = 0.1
"""Share of information below which a direction is unconstrained, as along a corridor."""
MAX_NEIGHBOURS = 120
"""Most keyframes registered to a patch: a robot may pass the same place all day."""
MIN_SHARE = 0.4
"""Share of a keyframe's points that must lie on a patch's lines."""


@dataclass(eq=False)
class Keyframe:
    """A scan that the map is built from.

    pose: (3,) current pose_map_base. step: (3,) pose relative to the previous keyframe, as matched. cloud: its points
    in the robot's frame. travelled: metres of the robot's path so far. slack: metres by which `step` may be off beyond
    the usual. lost: whether that is because odometry alone led here, as scans saw nothing, or nothing known; else
    matching and odometry contradicted each other.
    """

    pose: se2.Pose
    step: se2.Pose
    cloud: Cloud
    scan: Scan
    travelled: float
    slack: float = 0.0
    lost: bool = False


def step_edges(keyframes: list[Keyframe]) -> list[Edge]:
    """Return the edges from scan-to-scan matching: one between each keyframe and the next."""
    edges = []
    for i, keyframe in enumerate(keyframes[1:]):
        way, turn = float(np.hypot(*keyframe.step[:2])), abs(float(keyframe.step[2]))
        metres = STEP_SIGMA[0] + STEP_SIGMA[1] * way + keyframe.slack
        radians = STEP_SIGMA[2] + STEP_SIGMA[3] * turn + SLACK_TURN * keyframe.slack
        edges.append(Edge(i, i + 1, keyframe.step, np.diag([metres**-2, metres**-2, radians**-2])))
    return edges


def in_map(keyframe: Keyframe) -> Scan:
    """Return a keyframe's scan with its pose in the map, regardless of its stamp."""
    T_map_odom = se2.lifted(se2.compose(keyframe.pose, se2.inverse(keyframe.scan.pose_world_base)))
    return replace(keyframe.scan, T_world_sensor=T_map_odom @ keyframe.scan.T_world_sensor)


def in_second_frame(information: NDArray[np.float64], yaw: float) -> NDArray[np.float64]:
    """Return information (3, 3) about a frame's x, y, yaw, expressed along that frame's own axes."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    return turn.T @ information @ turn


def without_weak(information: NDArray[np.float64], floor: float) -> NDArray[np.float64]:
    """Return information (3, 3) without its weak direction.

    Along a corridor only noise constrains the position, and it pulls towards "has not moved".
    floor: share of the strongest direction's information below which a direction is dropped.
    """
    values, vectors = np.linalg.eigh(information[:2, :2])
    if values[0] >= floor * values[1]:
        return information
    keep = np.eye(3)
    keep[:2, :2] -= np.outer(vectors[:, 0], vectors[:, 0])
    return keep @ information @ keep


def patch_edges(keyframes: list[Keyframe], config: SlamConfig) -> Iterator[Edge]:
    """Yield edges from each keyframe to each patch of other keyframes nearby.

    A patch is a short run of keyframes, taken as rigid; edges go from its middle to the keyframe. Registration starts
    from the current poses, so these must be right to a decimetre or two.
    """
    places = np.array([keyframe.pose for keyframe in keyframes])
    patch = LineMap(config.voxel_size)
    for middle in range(0, len(keyframes), STRIDE):
        first, last = max(middle - PATCH, 0), min(middle + PATCH + 1, len(keyframes))
        others = _neighbours(places, middle, first, last, config)
        if not len(others):
            continue
        pose = places[middle]
        patch.build(joined([k.cloud.moved(se2.relative(pose, k.pose)) for k in keyframes[first:last]]))
        guesses = se2.relative(pose, places[others])
        for other, guess in zip(others.tolist(), guesses, strict=True):
            edge = _edge(patch, keyframes, (middle, other), guess, config)
            if edge is not None:
                yield edge


def _neighbours(places: se2.Pose, middle: int, first: int, last: int, config: SlamConfig) -> NDArray[np.int64]:
    far = np.hypot(*(places[:, :2] - places[middle, :2]).T)
    near = np.nonzero(far < config.refine_distance)[0]
    near = near[(near < first) | (near >= last)]
    return near[:: len(near) // MAX_NEIGHBOURS + 1]


def _edge(
    patch: LineMap, keyframes: list[Keyframe], pair: tuple[int, int], guess: se2.Pose, config: SlamConfig
) -> Edge | None:
    cloud = keyframes[pair[1]].cloud
    match = patch.refine(cloud, guess, 2 * config.sigma, iterations=6)
    match = patch.refine(cloud, match.pose, config.sigma, iterations=8)
    moved = match.pose - guess
    if match.share < MIN_SHARE or moved[0] ** 2 + moved[1] ** 2 > 0.1 or abs(moved[2]) > 0.1:
        return None
    information = without_weak(in_second_frame(match.information, float(match.pose[2])), WEAK)
    return Edge(*pair, match.pose, information)


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


BLOCK, EVERY = 10, 2
"""Keyframes judged together, and the stride of those inspected."""
VISIT_DISTANCE, VISIT_PATH = 4.0, 8.0
"""Largest distance between keyframes that see the same walls, and least path between two separate visits, in metres."""
MAX_POINT_RANGE = 8.0
"""Range in metres up to which points are certain enough to contradict other scans."""
MAX_OTHERS = 6
"""Most keyframes of other visits that one is compared with."""
MIN_POINTS, CONTRADICTED = 300, 0.4
"""Fewest points that judge a block, and the share of them seen through above which it is doubted: people and doors
move."""
MIN_SLACK = 0.2
"""Metres of slack below which a step is not doubted: odometry alone is good over a few scans."""
MIN_PART_PATH = 1.0
"""Metres of path between two steps with slack, below which they count as one."""
STRETCH, BENT, BENT_TURN = 20.0, 0.3, 0.09
"""Metres of path, and metres and radians by which loops may bend it: matching is off by about 2 %."""


@dataclass(frozen=True)
class MapDoubt:
    """Why a part of a map may be wrong.

    kind: `unseen` (matching and odometry contradicted each other, and nothing later shows which was right), `lost`
    (odometry alone carried the robot, and nothing later shows where to), `bent` (loops bent a stretch more than
    matching errors explain), `contradiction` (beams of this part pass through walls that another visit saw). begin_s,
    end_s: seconds of the drive, from its first keyframe. figure: metres of possible error or of bending, or the share
    of points seen through. turn_deg: degrees of bending, 0 for other kinds.
    """

    kind: str
    begin_s: float
    end_s: float
    figure: float
    turn_deg: float = 0.0

    def line(self) -> str:
        """Return one sentence for a user."""
        sentence = SENTENCES[self.kind].format(self.figure, bend=self._bend())
        return f"{self.kind}, {self.begin_s:.0f} to {self.end_s:.0f} s: {sentence}"

    def as_dict(self) -> dict[str, Any]:
        """Return the doubt for JSON."""
        return asdict(self)

    def _bend(self) -> str:
        """Return metres and degrees, whichever exceed their limits."""
        metres, turn = f"{self.figure:.1f} m", f"{self.turn_deg:.0f} degrees"
        if self.turn_deg <= np.degrees(BENT_TURN):
            return metres
        return f"{metres} and {turn}" if self.figure > BENT else turn


SENTENCES = {
    "unseen": "scans and odometry contradict each other by {:.1f} m and more, and the robot never returned to "
    "show which is right; drive there again",
    "lost": "scans saw nothing, or nothing known; odometry alone led on, off by up to {:.1f} m, and no loop joins what "
    "came before with what came after; drive there again",
    "bent": "loops bent 20 m of the trajectory by {bend}; the wheels slipped there, or a loop is wrong",
    "contradiction": "{:.0%} of the walls here are seen through on another visit; one of the two is in the wrong place",
}


def doubts_of(keyframes: Sequence[Keyframe], edges: Sequence[Edge]) -> list[MapDoubt]:
    """Return the doubts about a finished map, in order of time; `edges`: the loops closed."""
    found = [*_unseen(keyframes, edges), *_bent(keyframes), *_contradicted(keyframes)]
    return sorted(found, key=lambda doubt: (doubt.begin_s, doubt.kind))


def _doubt(
    keyframes: Sequence[Keyframe], kind: str, first: int, last: int, figure: float, turn: float = 0.0
) -> MapDoubt:
    start, begin, end = (keyframes[i].scan.stamp_ns for i in (0, first, last))
    return MapDoubt(kind, 1e-9 * (begin - start), 1e-9 * (end - start), float(figure), float(np.degrees(turn)))


def _unseen(keyframes: Sequence[Keyframe], edges: Sequence[Edge]) -> Iterator[MapDoubt]:
    """Yield the steps with slack whose two sides no loop joins."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    cuts = _cuts(keyframes)
    part = np.zeros(len(keyframes), np.int64)
    part[cuts] = 1
    part = np.cumsum(part)
    ends = np.array([(part[edge.first], part[edge.second]) for edge in edges], np.int64).reshape(-1, 2)
    size = len(cuts) + 1
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(size, size))
    _, joined = connected_components(graph, directed=False)
    for i in cuts:
        if joined[part[i - 1]] != joined[part[i]]:
            kind = "lost" if keyframes[i].lost else "unseen"
            yield _doubt(keyframes, kind, i - 1, i, keyframes[i].slack)


def _cuts(keyframes: Sequence[Keyframe]) -> list[int]:
    """Return the keyframes whose step has slack; of several close together, the last."""
    slack = [i for i, keyframe in enumerate(keyframes) if keyframe.slack > MIN_SLACK and i]
    way = [keyframe.travelled for keyframe in keyframes]
    return [i for i, later in zip_longest(slack, slack[1:]) if later is None or way[later] - way[i] > MIN_PART_PATH]


def _bent(keyframes: Sequence[Keyframe]) -> Iterator[MapDoubt]:
    """Yield the stretch that the graph bent most relative to matching, if too much."""
    way = np.array([keyframe.travelled for keyframe in keyframes])
    ends = np.minimum(np.searchsorted(way, way + STRETCH), len(way) - 1)
    final = np.array([keyframe.pose for keyframe in keyframes])
    matched = np.array(list(_chained(keyframes)))
    left = se2.relative(se2.relative(matched, matched[ends]), se2.relative(final, final[ends]))
    metres, radians = np.hypot(left[:, 0], left[:, 1]), np.abs(left[:, 2])
    worst = int(np.argmax(np.maximum(metres / BENT, radians / BENT_TURN)))
    if metres[worst] > BENT or radians[worst] > BENT_TURN:
        yield _doubt(keyframes, "bent", worst, int(ends[worst]), metres[worst], radians[worst])


def _chained(keyframes: Sequence[Keyframe]) -> Iterator[se2.Pose]:
    pose = np.zeros(3)
    for keyframe in keyframes:
        pose = se2.compose(pose, keyframe.step)
        yield pose


def _contradicted(keyframes: Sequence[Keyframe]) -> Iterator[MapDoubt]:
    """Yield the block with the largest share of points seen through, if it is too large."""
    places = np.array([keyframe.pose for keyframe in keyframes])
    way = np.array([keyframe.travelled for keyframe in keyframes])
    worst, where = CONTRADICTED, -1
    for first in range(0, len(keyframes), BLOCK):
        pairs = [
            _seen_through(keyframes, i, int(other))
            for i in range(first, min(first + BLOCK, len(keyframes)), EVERY)
            for other in _other_visits(places, way, i)
        ]
        crossed, met = np.sum(pairs, axis=0) if pairs else (0, 0)
        if met > MIN_POINTS and crossed / met > worst:
            worst, where = crossed / met, first
    if where >= 0:
        yield _doubt(keyframes, "contradiction", where, min(where + BLOCK, len(keyframes)) - 1, worst)


def _other_visits(places: se2.Pose, way: NDArray[np.float64], i: int) -> NDArray[np.int64]:
    """Return keyframes near keyframe i from other visits, evenly chosen."""
    near = np.hypot(*(places[:, :2] - places[i, :2]).T) < VISIT_DISTANCE
    others = np.flatnonzero(near & (np.abs(way - way[i]) > VISIT_PATH))
    return others[:: max(len(others) // MAX_OTHERS, 1)][:MAX_OTHERS]


def _seen_through(keyframes: Sequence[Keyframe], i: int, other: int) -> tuple[int, int]:
    """Count which points of another keyframe the scan of keyframe i sees through, and how many it could."""
    points = keyframes[other].cloud.points
    points = points[(points**2).sum(axis=1) < MAX_POINT_RANGE**2]
    between = se2.relative(keyframes[i].pose, keyframes[other].pose)
    return through(keyframes[i].cloud, se2.transform(between, points))
