# SPDX-License-Identifier: Apache-2.0
"""Lays one submap onto another, wherever in a window it fits best: branch and bound, then least squares."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import planar
from stereovox.config_robot import SlamConfig
from stereovox.localize import _bound
from stereovox.localize.line_map import Cloud, LineMap, Match

COARSE = 2
"""Cells of the map on the side of one cell of the search."""
SEEDS = 400
"""Points of a submap that the search looks at."""
LEVELS = 6
RIVAL = 0.6
"""Metres from the best place, within which a good score is the same place's."""


class ClosureSearch:
    """Searches the place of clouds on the map of an earlier cloud."""

    def __init__(self, config: SlamConfig):
        self._config = config
        self._coarse = LineMap(COARSE * config.voxel_size, reach=0.3, sigma=0.12)
        self._fine = LineMap(config.voxel_size, reach=0.4)
        self._pad = 1 << LEVELS
        self._pyramid = np.empty((LEVELS, 0, 0), np.float32)

    def onto(self, earlier: Cloud) -> None:
        """Take the cloud that the next ones are laid onto."""
        self._coarse.build(earlier)
        self._fine.build(earlier)
        rows, columns = self._coarse.extent
        self._pyramid = np.empty((LEVELS, rows + self._pad, columns + self._pad), np.float32)
        _bound.coarsen(self._coarse.score[:rows, :columns], self._pad, self._pyramid)

    def lay(self, cloud: Cloud, guess: ArrayLike, side: float, side_yaw: float) -> Match | None:
        """Return the best match of a cloud within `side` metres and `side_yaw` of a guess.

        None where no place is good enough, or another one is nearly as good.
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

    def place(self, seeds: NDArray[np.float32], guess: planar.Pose, side: float, side_yaw: float) -> planar.Pose | None:
        """Return the pose with the best score, None where it is below `closure_score` or has a rival."""
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
