# SPDX-License-Identifier: Apache-2.0
"""Finds where the robot comes back to, and believes it only where two findings agree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox import planar
from stereovox.config_robot import SlamConfig
from stereovox.localize.line_map import Cloud
from stereovox.localize.slam_closure import ClosureSearch
from stereovox.localize.slam_keyframe import Edge, Keyframe, in_second_frame
from stereovox.localize.slam_submap import Submap, submap_cloud

ROOM = 4.0
"""Metres by which two submaps' middles may be apart and still show the same walls, beyond what drift explains."""
NEAR_RANGE, FAR_RANGE = 10.0, 20.0
"""Metres from the robot up to which points of the later, and of the earlier submap are used: what is near is seen from
both."""
BASE_WINDOW, BASE_WINDOW_TURN = 0.5, 0.1
"""Metres and radians that are searched even where no drift is to be feared."""
CORRIDOR = 0.03
"""Share of the strongest direction's information below which the weakest is a corridor's: no closure there."""
MOST_TRIED = 16
"""Earlier submaps that a new one is laid onto, the nearest: a robot may pass the same place all day."""
WITNESS_PATH = 15.0
"""Metres of way within which two findings can bear each other out."""
WITNESS = (0.1, 0.02, 0.02)
"""How far they may disagree: metres, metres per metre of way, radians."""

SHORT_CUT = 1e-3
"""Metres along which drift adds up over a closure: none, but a graph has no edges of length 0."""


class LoopFinder:
    """Keeps the submaps so far, and finds edges between those that show the same place.

    edges: closures believed. candidates: all that were found.
    """

    def __init__(self, config: SlamConfig, keyframes: list[Keyframe]):
        self.edges: list[Edge] = []
        self.candidates: list[Edge] = []
        self._config, self._keyframes = config, keyframes
        self._search = ClosureSearch(config)
        self._submaps: list[Submap] = []

    def update(self, end: bool = False) -> list[Edge]:
        """Search for the places of submaps that are complete since the last call; return the edges now believed too."""
        before, size = len(self.edges), self._config.submap_keyframes
        while True:
            first = len(self._submaps) * max(size // 2, 1)
            last = first + size
            if len(self._keyframes) < last and not (end and len(self._keyframes) > first + size // 2):
                return self.edges[before:]
            self._submaps.append(Submap(first, min(last, len(self._keyframes))))
            self._close(self._submaps[-1])

    def _close(self, later: Submap) -> None:
        ways = self._ways()
        cloud = submap_cloud(self._keyframes, later, NEAR_RANGE, cell=2 * self._config.voxel_size)
        windows: dict[Submap, tuple[float, float]] = {}
        for earlier, way in zip(self._submaps[:-1], ways.tolist(), strict=False):
            window = self._window(earlier, later, way)
            if window is not None:
                windows[earlier] = window
        there = self._keyframes[later.anchor].pose
        near = sorted(windows, key=lambda e: float(np.hypot(*(self._keyframes[e.anchor].pose - there)[:2])))
        for earlier in near[:MOST_TRIED]:
            self._search.onto(submap_cloud(self._keyframes, earlier, FAR_RANGE))
            self._lay(earlier, later, cloud, windows[earlier])

    def _lay(self, earlier: Submap, later: Submap, cloud: Cloud, window: tuple[float, float]) -> None:
        first, second = earlier.anchor, later.anchor
        guess = planar.relative(self._keyframes[first].pose, self._keyframes[second].pose)
        match = self._search.lay(cloud, guess, *window)
        if match is None or match.share < self._config.closure_share:
            return
        along = np.linalg.eigvalsh(match.information[:2, :2])
        if along[0] < CORRIDOR * along[1]:
            return
        found = Edge(first, second, match.pose, in_second_frame(match.information, float(match.pose[2])), match.share)
        self._judge(found)

    def _judge(self, found: Edge) -> None:
        """Believe a finding, and those it bears out, once one other agrees with it."""
        witnesses = [other for other in self.candidates if self._agree(found, other)]
        self.candidates.append(found)
        if witnesses:
            self.edges += [edge for edge in (*witnesses, found) if edge not in self.edges]

    def _agree(self, a: Edge, b: Edge) -> bool:
        keyframes = self._keyframes
        way = sum(
            abs(keyframes[i].travelled - keyframes[k].travelled) for i, k in ((a.first, b.first), (a.second, b.second))
        )
        if way > WITNESS_PATH:
            return False
        over = planar.relative(keyframes[a.first].pose, keyframes[b.first].pose)
        back = planar.relative(keyframes[b.second].pose, keyframes[a.second].pose)
        left = planar.relative(a.motion, planar.compose(planar.compose(over, b.motion), back))
        return bool(np.hypot(left[0], left[1]) < WITNESS[0] + WITNESS[1] * way and abs(left[2]) < WITNESS[2])

    def _window(self, earlier: Submap, later: Submap, way: float) -> tuple[float, float] | None:
        """Metres and radians to search for the later submap, None where it cannot show the same place."""
        config, a, b = self._config, self._keyframes[earlier.anchor], self._keyframes[later.anchor]
        if b.travelled - a.travelled < config.closure_path:
            return None
        side = min(BASE_WINDOW + config.drift * way, config.closure_window)
        if np.hypot(*(b.pose - a.pose)[:2]) > side + ROOM:
            return None
        return side, min(BASE_WINDOW_TURN + config.drift_turn * way, config.closure_window_turn)

    def _ways(self) -> NDArray[np.float64]:
        """Metres along which drift adds up between the last submap and each other one: closures are short cuts."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import dijkstra

        anchors = [submap.anchor for submap in self._submaps]
        number = {anchor: i for i, anchor in enumerate(anchors)}
        along = np.array([self._keyframes[anchor].travelled for anchor in anchors])
        steps = {(i, i + 1): max(float(way), SHORT_CUT) for i, way in enumerate(np.diff(along))}
        # One length for each pair: a matrix made of several adds them up.
        lengths = steps | {(number[edge.first], number[edge.second]): SHORT_CUT for edge in self.edges}
        rows, columns = np.array(list(lengths), np.int64).reshape(-1, 2).T
        graph = coo_matrix((list(lengths.values()), (rows, columns)), shape=(len(anchors), len(anchors)))
        return dijkstra(graph.tocsr(), directed=False, indices=len(anchors) - 1)
