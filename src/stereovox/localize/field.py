# SPDX-License-Identifier: Apache-2.0
"""How far it is from any place to the nearest occupied cell of a map: the likelihood field before the likelihood."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import planar
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.voxel_map import State


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Distances to the nearest occupied cell, cell by cell.

    distance_m: (rows, columns) float32 metres from a cell's middle to the middle of the nearest occupied cell, at most
        `farthest`; 0 in occupied cells.
    resolution, origin: as in `OccupancyGrid`.
    farthest: metres that stand for anything further away, and for all that lies outside of the map.
    """

    distance_m: NDArray[np.float32]
    resolution: float
    origin: tuple[float, float, float]
    farthest: float

    def at(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the (N,) float32 distance of the cells that hold (N, 2) points x, y of the map's frame, in metres."""
        cells = np.floor(self.in_cells(points))
        columns, rows = cells[:, 0], cells[:, 1]
        inside = (rows >= 0) & (columns >= 0) & (rows < self.distance_m.shape[0]) & (columns < self.distance_m.shape[1])
        found = np.full(len(cells), self.farthest, np.float32)
        found[inside] = self.distance_m[rows[inside].astype(np.int64), columns[inside].astype(np.int64)]
        return found

    def in_cells(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return (N, 2) points of the map's frame as columns and rows: (0, 0) is the corner of cell (0, 0)."""
        return planar.transform(planar.inverse(self.origin), points) / self.resolution


def distance_field(grid: OccupancyGrid, farthest: float = np.inf) -> DistanceField:
    """Return the exact Euclidean distances of a map; all of it is `farthest` (metres) where nothing is occupied."""
    from scipy.ndimage import distance_transform_edt

    occupied = grid.states == State.OCCUPIED
    if occupied.any():
        distance = np.asarray(distance_transform_edt(~occupied), np.float32) * np.float32(grid.resolution)
    else:
        distance = np.full(occupied.shape, farthest, np.float32)
    return DistanceField(np.minimum(distance, np.float32(farthest)), grid.resolution, grid.origin, farthest)
