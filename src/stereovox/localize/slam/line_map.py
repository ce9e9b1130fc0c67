# SPDX-License-Identifier: Apache-2.0
"""A map of short lines from the points of scans, and registration of scans to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.slam import _lines, _match

NEAR = 0.15
"""Metres around a cell whose points a line is fitted to."""
POINT_WEIGHT = 0.3
"""Weight of a point at a corner, relative to one on a line: its nearest point is a guess."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """The points of one scan, in the robot's frame.

    points: (N, 2) float32 metres. views: (N, 2) float32, from each point towards the sensor, length 1.
    """

    points: NDArray[np.float32]
    views: NDArray[np.float32]

    def moved(self, pose: ArrayLike) -> Cloud:
        """Return the cloud in the frame in which `pose` (3,) is given."""
        x, y, yaw = np.asarray(pose, float)
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        points = self.points @ turn + (x, y)
        return Cloud(points.astype(np.float32), (self.views @ turn).astype(np.float32))


def cloud_of(scan: Scan, max_range: float) -> Cloud:
    """Return the hits of a scan between the sensor's least range and `max_range` metres."""
    ranges = np.asarray(scan.ranges, float)
    with np.errstate(invalid="ignore"):
        hit = (ranges > max(scan.range_min, 1e-3)) & (ranges < min(scan.range_max, max_range))
    angles = scan.angles[hit]
    ahead = np.column_stack([np.cos(angles), np.sin(angles)]) @ scan.T_base_sensor[:2, :2].T
    points = scan.T_base_sensor[:2, 3] + ranges[hit, None] * ahead
    return Cloud(points.astype(np.float32), -ahead.astype(np.float32))


def joined(clouds: list[Cloud]) -> Cloud:
    """Return several clouds of one frame, joined."""
    return Cloud(np.concatenate([c.points for c in clouds]), np.concatenate([c.views for c in clouds]))


@dataclass(frozen=True, eq=False)
class Match:
    """The registration of a scan to a map.

    pose: (3,) x, y, yaw. information: (3, 3) of the scan alone (in the map's frame), in units of 1/m^2 and 1/rad^2 for
    distances with a standard deviation of `sigma`. share: of the scan's points within `sigma` of a line of the map.
    rms: weighted distance in metres of the points from their lines.
    """

    pose: se2.Pose
    information: NDArray[np.float64]
    share: float
    rms: float


class LineMap:
    """Points of many scans as lines in a grid of `cell` metres; rebuilt by `build`, which reuses the memory.

    reach: metres from the points within which lines attract. sigma: metres of the likelihood field. fewest: points of a
    neighbourhood below which scans are not matched to it.
    """

    def __init__(self, cell: float, reach: float = 0.25, sigma: float = 0.08, fewest: int = 1):
        self.cell, self.sigma = cell, sigma
        self._fewest = np.float32(fewest)
        self._reach = max(round(reach / cell), 1)
        self._radius = max(round(NEAR / cell), 1)
        self.corner = np.zeros(2)
        self._extent = (0, 0)
        self.near = np.empty((0, 0), np.int32)
        self.index, self.score = self.near.copy(), np.empty((0, 0), np.float32)
        self.cells = np.empty((0, 2), np.int32)
        self.lines = np.empty((0, 8), np.float32)

    def build(self, cloud: Cloud, shift: ArrayLike = (0.0, 0.0)) -> LineMap:
        """Build the map from a cloud, whose frame is `shift` metres from the map's. Return it."""
        _lines.wipe(self.cells, self._reach, self.index, self.near, self.score)
        points = cloud.points
        margin = (self._reach + 2) * self.cell
        least, most = np.zeros(2), np.zeros(2)
        _lines.bounds(points, least, most)
        corner = np.floor((least - margin) / self.cell) * self.cell
        columns, rows = np.ceil((most + margin - corner) / self.cell).astype(int).tolist()
        self._resize(rows, columns)
        self.corner = corner + np.asarray(shift, float)
        cells, sums = np.empty((len(points), 2), np.int32), np.empty((len(points), 8), np.float32)
        cell = np.float32(self.cell)
        count = _lines.gather(points, corner, cloud.views, cell, self.index, cells, sums)
        self.cells = cells[:count]
        self.lines = np.empty((count, 8), np.float32)
        _lines.fit(self.index, self.cells, sums[:count], cell, self._radius, self._fewest, self.lines)
        _lines.spread(self.cells, self.lines, cell, self._reach, np.float32(self.sigma), self.near, self.score)
        return self

    @property
    def extent(self) -> tuple[int, int]:
        """Rows and columns in use; more may be allocated."""
        return self._extent

    def _resize(self, rows: int, columns: int) -> None:
        self._extent = rows, columns
        if rows > self.near.shape[0] or columns > self.near.shape[1]:
            room = max(rows, self.near.shape[0]) + 40, max(columns, self.near.shape[1]) + 40
            self.near = np.full(room, -1, np.int32)
            self.index = self.near.copy()
            self.score = np.zeros(room, np.float32)

    def search(
        self,
        points: NDArray[np.float32],
        guess: ArrayLike,
        side: float,
        side_yaw: float,
        step_yaw: float,
        slope: float,
        slope_yaw: float,
    ) -> tuple[se2.Pose, float]:
        """Return the likeliest pose in a window around a guess, and its likelihood (see `_match.search`)."""
        start, best = self._local(guess), np.empty(3)
        cells, turns = int(np.ceil(side / self.cell)), int(np.ceil(side_yaw / step_yaw))
        top = _match.search(
            points, start, self.score, np.float32(self.cell), cells, turns, step_yaw, slope, slope_yaw, best
        )
        return self._global(best), float(top)

    def refine(
        self,
        cloud: Cloud,
        guess: ArrayLike,
        sigma: float,
        prior: ArrayLike | None = None,
        information: NDArray[np.float64] | None = None,
        iterations: int = 15,
    ) -> Match:
        """Return the pose near `guess` at which the points lie on the lines; `prior` pulls with its `information`."""
        pose = self._local(guess)
        normal, cost = np.zeros((3, 3)), np.zeros(2)
        pull = np.zeros((3, 3)) if information is None else information
        held = self._local(guess if prior is None else prior)
        on = _match.refine(
            cloud.points, cloud.views, self.near, self.lines, self.cell, sigma, POINT_WEIGHT, held, pull, iterations,
            pose, normal, cost,
        )  # fmt: skip
        return Match(self._global(pose), normal, on / max(len(cloud.points), 1), float(np.sqrt(cost[0])))

    def _local(self, pose: ArrayLike) -> se2.Pose:
        local = np.array(pose, float)
        local[:2] -= self.corner
        return local

    def _global(self, pose: se2.Pose) -> se2.Pose:
        found = pose.copy()
        found[:2] += self.corner
        found[2] = float(se2.wrapped(found[2]))
        return found
