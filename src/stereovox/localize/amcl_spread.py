# SPDX-License-Identifier: Apache-2.0
"""Where a robot may be: anywhere on the free floor, or near a pose that somebody gave."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import planar
from stereovox.errors import ConfigError, MapFileError
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.voxel_map import State


class FreeFloor:
    """The free cells of a map. Raises MapFileError where there is none, or nothing occupied to go by."""

    def __init__(self, grid: OccupancyGrid):
        states = grid.states
        self.grid = grid
        self._free = np.flatnonzero(states == State.FREE).astype(np.uint32)
        for state, count in (("free", len(self._free)), ("occupied", int((states == State.OCCUPIED).sum()))):
            if not count:
                raise MapFileError(f"the map has no {state} cell: nobody can be localised in it; give a finished map")

    def anywhere(self, count: int, rng: np.random.Generator) -> planar.Pose:
        """Return (count, 3) poses evenly spread over all free cells and directions."""
        chosen = self._free[rng.integers(len(self._free), size=count)]
        rows, columns = np.divmod(chosen, np.uint32(self.grid.cells.shape[1]))
        local = (np.column_stack([columns, rows]) + rng.random((count, 2))) * self.grid.resolution
        turns = rng.uniform(-np.pi, np.pi, count)
        return np.column_stack([planar.transform(self.grid.origin, local), turns])


def near(start: planar.Pose, std: ArrayLike, count: int, rng: np.random.Generator) -> planar.Pose:
    """Return (count, 3) poses normally distributed round a (3,) pose; std: (3,) metres, metres, radians."""
    poses = start + rng.standard_normal((count, 3)) * np.asarray(std)
    poses[:, 2] = planar.wrapped(poses[:, 2])
    return poses


def checked_start(start: ArrayLike) -> NDArray[np.float64]:
    """Return a start pose as (3,) float64. Raises ConfigError, one line, where it is none."""
    try:
        pose = np.asarray(start, float)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ConfigError(f"start {start!r}: give three finite numbers x, y, yaw (metres, metres, radians), or none")
    return pose
