# SPDX-License-Identifier: Apache-2.0
"""A finished map's self-check against its own scans.

The limits were chosen on seeds 0 to 99 of `benchmarks/slam_drives.py` and on the logs ACES, MIT-CSAIL and fr079.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry import se2
from stereovox.geometry.pose_graph import Edge
from stereovox.localize.slam.graph import Keyframe
from stereovox.localize.slam.odometry_check import through

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
