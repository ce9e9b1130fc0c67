# SPDX-License-Identifier: Apache-2.0
"""How well a motion lays the walls of one 2-D map on those of another, and the motion near it that does so best."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import planar

FEW, MANY = 600, 4000
"""Walls and floor cells of each map that are looked at, evenly taken: to sort out motions, and to find the best."""
MOST_ACROSS = 3000
"""Pixels along the longer side of a picture of distances; larger maps get larger pixels."""
STEPS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
Points = NDArray[np.float64]
"""(N, 2) x, y in metres."""


class Fit:
    """Two maps as points: middles of their occupied and free cells, in metres from the lower left corner of each.

    walls, their_walls: at least one each. resolution: side of a cell in metres. reach: metres up to which distances
    matter.
    """

    def __init__(
        self, walls: Points, their_walls: Points, floor: Points, their_floor: Points, resolution: float, reach: float
    ):
        self.resolution = resolution
        self._walls, self._their_walls, self._floor = walls, their_walls, floor
        self._ours, self._theirs = (_Field(one, resolution, 4 * reach) for one in (walls, their_walls))
        self._their_floor = _Field(their_floor, resolution, reach) if len(their_floor) else None
        self._middle = (walls.min(axis=0) + walls.max(axis=0)) / 2
        self._radius = max(float(np.hypot(*np.ptp(walls, axis=0))) / 2, resolution)

    def likelihood(self, pose: ArrayLike, width: float, most: int = MANY) -> float:
        """Return how well walls lie on walls, 0 to 1: mean of exp(-d^2 / (2 width^2)) both ways.

        pose: (3,), our corner seen from theirs; width in metres; most: points of each map to look at.
        """
        there = planar.transform(pose, evenly(self._walls, most))
        back = planar.transform(planar.inverse(pose), evenly(self._their_walls, most))
        pairs = ((self._theirs, there), (self._ours, back))
        return float(np.mean([np.exp(-0.5 * (field.metres(at) / width) ** 2).mean() for field, at in pairs]))

    def agreement(self, pose: ArrayLike) -> float:
        """Return the likelihood for walls two cells wide, and the share of our floor that lies on theirs; 0 to 2."""
        walls = self.likelihood(pose, 2 * self.resolution)
        if not len(self._floor) or self._their_floor is None:
            return walls
        metres = self._their_floor.metres(planar.transform(pose, evenly(self._floor, MANY)))
        return walls + float((metres < self.resolution).mean())

    def refined(self, pose: ArrayLike, width: float, stop: float, most: int = MANY) -> planar.Pose:
        """Return the pose near `pose` of the highest likelihood: steps along x, y and yaw, halved where none helps.

        The likelihood's width is `width` at first and half as much at the end; `stop` is the smallest step in metres.
        """
        best = np.asarray(pose, float)
        for reach in (width, width / 2):
            score, step = self.likelihood(best, reach, most), reach
            while step > stop:
                tried = [self._stepped(best, step * np.array(one)) for one in STEPS]
                scores = [self.likelihood(one, reach, most) for one in tried]
                if max(scores) > score + 1e-9:
                    score, best = max(scores), tried[int(np.argmax(scores))]
                else:
                    step /= 2
        return best

    def way(self, start: ArrayLike, end: ArrayLike) -> float:
        """Return the metres by which two poses differ: of the map's middle, and of its rim by the turn."""
        x, y, yaw = planar.relative(self._at_middle(start), self._at_middle(end))
        return float(np.hypot(x, y) + self._radius * abs(yaw))

    def _at_middle(self, pose: ArrayLike) -> planar.Pose:
        return planar.compose(pose, [*self._middle, 0.0])

    def _stepped(self, pose: planar.Pose, step: NDArray[np.float64]) -> planar.Pose:
        """Return the pose moved by step[:2] and turned about the walls' middle so that their rim moves step[2]."""
        x, y, yaw = self._at_middle(pose) + step * [1, 1, 1 / self._radius]
        return planar.compose([x, y, yaw], [-self._middle[0], -self._middle[1], 0.0])


class _Field:
    """Distances to the nearest of some points, as a picture."""

    def __init__(self, points: Points, resolution: float, margin: float):
        from scipy.ndimage import distance_transform_edt

        across = float(np.ptp(points, axis=0).max()) + 2 * margin
        self._side = max(resolution, across / MOST_ACROSS)
        self._low = points.min(axis=0) - (np.ceil(margin / self._side)) * self._side
        cells = np.rint((points - self._low) / self._side).astype(np.int64)
        empty = np.ones(cells.max(axis=0)[::-1] + 1 + int(np.ceil(margin / self._side)), bool)
        empty[cells[:, 1], cells[:, 0]] = False
        self._metres = np.asarray(distance_transform_edt(empty, sampling=self._side), np.float32)

    def metres(self, points: Points) -> NDArray[np.float32]:
        """Return the distance of (N, 2) points, between pixels in proportion; beyond the picture that of its rim."""
        from scipy.ndimage import map_coordinates

        places = (points - self._low).T[::-1] / self._side
        return np.asarray(map_coordinates(self._metres, places, order=1, mode="nearest"), np.float32)


def evenly(points: NDArray[Any], most: int) -> NDArray[Any]:
    """Return at most `most` rows of an array, evenly taken."""
    if len(points) <= most:
        return points
    return points[np.linspace(0, len(points) - 1, most).astype(int)]
