# SPDX-License-Identifier: Apache-2.0
"""Loop closure: finds revisited places, and accepts them only if two findings agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config.robot import SlamConfig
from stereovox.geometry import se2
from stereovox.geometry.pose_graph import Edge
from stereovox.localize.slam import _bound
from stereovox.localize.slam.graph import Keyframe, in_second_frame
from stereovox.localize.slam.line_map import Cloud, LineMap, Match, joined

COARSE = 2
"""Map cells per side of a search cell."""
SEEDS = 400
"""Points of a submap used by the search."""
LEVELS = 6
"""Levels of the search's pyramid: its coarsest cells are 2^5 of the finest across."""
RIVAL = 0.6
"""Metres around the best place within which a good score is the same place."""
MAX_APART = 4.0
"""Largest distance in metres, beyond drift, between the middles of two submaps that show the same walls."""
NEAR_RANGE, FAR_RANGE = 10.0, 20.0
"""Range in metres of the points used from the later, and from the earlier submap: near surfaces are seen from both."""
BASE_WINDOW, BASE_WINDOW_TURN = 0.5, 0.1
"""Search window in metres and radians without drift."""
CORRIDOR = 0.03
"""Share of the strongest direction's information below which the weakest is a corridor's: no closure there."""
MAX_TRIED = 16
"""Most earlier submaps a new one is matched to, the nearest: a robot may pass the same place all day."""
WITNESS_PATH = 15.0
"""Metres of path within which two findings can confirm each other."""
WITNESS = (0.1, 0.02, 0.02)
"""How far they may disagree: metres, metres per metre of path, radians."""
SHORT_CUT = 1e-3
"""Metres of drift path over a closure: nearly 0, because the graph has no edges of length 0."""


class LoopFinder:
    """Keeps the submaps so far, and finds edges between submaps that show the same place.

    edges: accepted closures. candidates: all closures found.
    """

    def __init__(self, config: SlamConfig, keyframes: list[Keyframe]):
        self.edges: list[Edge] = []
        self.candidates: list[Edge] = []
        self._config, self._keyframes = config, keyframes
        self._search = ClosureSearch(config)
        self._submaps: list[Submap] = []

    def update(self, end: bool = False) -> list[Edge]:
        """Match the submaps completed since the last call; return the newly accepted edges."""
        before, size = len(self.edges), self._config.submap_keyframes
        while True:
            first = len(self._submaps) * max(size // 2, 1)
            last = first + size
            if len(self._keyframes) < last and not (end and len(self._keyframes) > first + size // 2):
                return self.edges[before:]
            self._submaps.append(Submap(first, min(last, len(self._keyframes))))
            self._close(self._submaps[-1])

    def _close(self, later: Submap) -> None:
        drift_distances = self._drift_distances()
        cloud = submap_cloud(self._keyframes, later, NEAR_RANGE, cell=2 * self._config.voxel_size)
        windows: dict[Submap, tuple[float, float]] = {}
        for earlier, path_m in zip(self._submaps[:-1], drift_distances.tolist(), strict=False):
            window = self._window(earlier, later, path_m)
            if window is not None:
                windows[earlier] = window
        there = self._keyframes[later.anchor].pose
        near = sorted(windows, key=lambda e: float(np.hypot(*(self._keyframes[e.anchor].pose - there)[:2])))
        for earlier in near[:MAX_TRIED]:
            self._search.set_target(submap_cloud(self._keyframes, earlier, FAR_RANGE))
            self._match_pair(earlier, later, cloud, windows[earlier])

    def _match_pair(self, earlier: Submap, later: Submap, cloud: Cloud, window: tuple[float, float]) -> None:
        first, second = earlier.anchor, later.anchor
        guess = se2.relative(self._keyframes[first].pose, self._keyframes[second].pose)
        match = self._search.match(cloud, guess, *window)
        if match is None or match.share < self._config.closure_share:
            return
        along = np.linalg.eigvalsh(match.information[:2, :2])
        if along[0] < CORRIDOR * along[1]:
            return
        information = in_second_frame(match.information, float(match.pose[2]))
        self._judge(Edge(first, second, match.pose, information))

    def _judge(self, found: Edge) -> None:
        """Accept a finding, and the ones it confirms, once another agrees with it."""
        witnesses = [other for other in self.candidates if self._agree(found, other)]
        self.candidates.append(found)
        if witnesses:
            self.edges += [edge for edge in (*witnesses, found) if edge not in self.edges]

    def _agree(self, a: Edge, b: Edge) -> bool:
        keyframes = self._keyframes
        path_m = sum(
            abs(keyframes[i].travelled - keyframes[k].travelled) for i, k in ((a.first, b.first), (a.second, b.second))
        )
        if path_m > WITNESS_PATH:
            return False
        over = se2.relative(keyframes[a.first].pose, keyframes[b.first].pose)
        back = se2.relative(keyframes[b.second].pose, keyframes[a.second].pose)
        left = se2.relative(a.motion, se2.compose(se2.compose(over, b.motion), back))
        return bool(np.hypot(left[0], left[1]) < WITNESS[0] + WITNESS[1] * path_m and abs(left[2]) < WITNESS[2])

    def _window(self, earlier: Submap, later: Submap, path_m: float) -> tuple[float, float] | None:
        """Search window in metres and radians for the later submap, None if it cannot show the same place."""
        config, a, b = self._config, self._keyframes[earlier.anchor], self._keyframes[later.anchor]
        if b.travelled - a.travelled < config.closure_path:
            return None
        side = min(BASE_WINDOW + config.drift * path_m, config.closure_window)
        if np.hypot(*(b.pose - a.pose)[:2]) > side + MAX_APART:
            return None
        return side, min(BASE_WINDOW_TURN + config.drift_turn * path_m, config.closure_window_turn)

    def _drift_distances(self) -> NDArray[np.float64]:
        """Metres over which drift accumulates between the last submap and each other one: closures are short cuts."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import dijkstra

        anchors = [submap.anchor for submap in self._submaps]
        number = {anchor: i for i, anchor in enumerate(anchors)}
        along = np.array([self._keyframes[anchor].travelled for anchor in anchors])
        steps = {(i, i + 1): max(float(path_m), SHORT_CUT) for i, path_m in enumerate(np.diff(along))}
        # one length per pair: building the matrix would sum duplicates
        lengths = steps | {(number[edge.first], number[edge.second]): SHORT_CUT for edge in self.edges}
        rows, columns = np.array(list(lengths), np.int64).reshape(-1, 2).T
        graph = coo_matrix((list(lengths.values()), (rows, columns)), shape=(len(anchors), len(anchors)))
        return dijkstra(graph.tocsr(), directed=False, indices=len(anchors) - 1)


class ClosureSearch:
    """Finds the pose of clouds on the map of an earlier cloud."""

    def __init__(self, config: SlamConfig):
        self._config = config
        self._coarse = LineMap(COARSE * config.voxel_size, reach=0.3, sigma=0.12)
        self._fine = LineMap(config.voxel_size, reach=0.4)
        self._pad = 1 << LEVELS
        self._pyramid = np.empty((LEVELS, 0, 0), np.float32)

    def set_target(self, earlier: Cloud) -> None:
        """Set the cloud that the next ones are matched against."""
        self._coarse.build(earlier)
        self._fine.build(earlier)
        rows, columns = self._coarse.extent
        self._pyramid = np.empty((LEVELS, rows + self._pad, columns + self._pad), np.float32)
        _bound.coarsen(self._coarse.score[:rows, :columns], self._pad, self._pyramid)

    def match(self, cloud: Cloud, guess: ArrayLike, side: float, side_yaw: float) -> Match | None:
        """Return the best match of a cloud within `side` metres and `side_yaw` of a guess.

        None if no place is good enough, or another one is nearly as good.
        """
        seeds = cloud.points[:: max(len(cloud.points) // SEEDS, 1)]
        if not len(seeds):
            return None
        pose = self.place(seeds, np.asarray(guess, float), side, side_yaw)
        if pose is None:
            return None
        match = self._fine.refine(cloud, pose, 0.3)
        for sigma in (0.15, 1.5 * self._config.sigma):
            match = self._fine.refine(cloud, match.pose, sigma)
        return match

    def place(self, seeds: NDArray[np.float32], guess: se2.Pose, side: float, side_yaw: float) -> se2.Pose | None:
        """Return the pose with the best score, None if the score is below `closure_score` or has a rival."""
        cell, config = self._coarse.cell, self._config
        step = cell / max(float(np.sqrt((seeds**2).sum(axis=1).max())), 1.0)
        turns = int(np.ceil(side_yaw / step))
        yaws = guess[2] + step * np.arange(-turns, turns + 1)
        cosine, sine = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
        x = guess[0] - self._coarse.corner[0] + cosine * seeds[:, 0] - sine * seeds[:, 1]
        y = guess[1] - self._coarse.corner[1] + sine * seeds[:, 0] + cosine * seeds[:, 1]
        places = np.floor(np.stack([y, x], axis=-1) / cell).astype(np.int32)
        cells, least = int(np.ceil(side / cell)), np.float32(config.closure_score * len(seeds))
        best, rival, nowhere = np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(3, np.int64)
        top = _bound.climb(places, cells, self._pyramid, self._pad, least, nowhere, -1, best)
        if top <= least:
            return None
        least = np.float32(config.closure_rival * top)
        apart = round(RIVAL / cell)
        if _bound.climb(places, cells, self._pyramid, self._pad, least, best, apart, rival) > least:
            return None
        return np.array([guess[0] + best[2] * cell, guess[1] + best[1] * cell, yaws[best[0]]])


@dataclass(frozen=True)
class Submap:
    """A run of keyframes short enough not to drift: keyframes `first` to `last` - 1."""

    first: int
    last: int

    @property
    def anchor(self) -> int:
        """The middle keyframe, whose frame is the submap's."""
        return (self.first + self.last) // 2


def submap_cloud(keyframes: list[Keyframe], submap: Submap, max_range: float, cell: float = 0.0) -> Cloud:
    """Return the points of a submap within `max_range` of each robot pose, in its anchor's frame.

    cell: side in metres of squares that keep one point each; 0: all points.
    """
    pose = keyframes[submap.anchor].pose
    clouds = []
    for keyframe in keyframes[submap.first : submap.last]:
        if np.hypot(*(keyframe.pose - pose)[:2]) > max_range:
            continue  # the odometry jumped
        near = (keyframe.cloud.points**2).sum(axis=1) < max_range**2
        part = Cloud(keyframe.cloud.points[near], keyframe.cloud.views[near])
        clouds.append(part.moved(se2.relative(pose, keyframe.pose)))
    cloud = joined(clouds)
    if not cell or not len(cloud.points):
        return cloud
    squares = np.floor(cloud.points / cell).astype(np.int64)
    _, first = np.unique(squares[:, 0] * (1 << 32) + squares[:, 1], return_index=True)
    first.sort()
    return Cloud(cloud.points[first], cloud.views[first])
