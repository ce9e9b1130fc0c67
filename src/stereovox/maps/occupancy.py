# SPDX-License-Identifier: Apache-2.0
"""A finished 2-D map as plain numbers: what map_server serves, AMCL localises in, and two maps are compared as."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import planar
from stereovox.maps.voxel_map import State

UNKNOWN = -1


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """A picture of a floor, in the meaning of `nav_msgs/OccupancyGrid`.

    cells: (rows, columns) int8, probability of being occupied in per cent (0 to 100), -1 unknown. Row 0 is the lowest
        y, column 0 the lowest x.
    resolution: side of a cell in metres.
    origin: (3,) x, y, yaw of the lower left corner of cell (0, 0) in the map's frame.
    free_below, occupied_above: probabilities below and above which a known cell counts as free, and as occupied.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    free_below: float = 0.3
    occupied_above: float = 0.7

    @property
    def states(self) -> NDArray[np.uint8]:
        """`State` of each cell, (rows, columns) uint8."""
        percent = np.arange(256, dtype=np.uint8).view(np.int8).astype(float)
        states = np.full(256, State.TENTATIVE, np.uint8)
        states[percent < 100 * self.free_below] = State.FREE
        states[percent > 100 * self.occupied_above] = State.OCCUPIED
        states[percent < 0] = State.UNKNOWN
        return states[self.cells.view(np.uint8)]

    @property
    def known_span(self) -> tuple[slice, slice]:
        """The rows and columns from the first to the last of which a cell is known; both empty where none is."""
        known = self.cells != UNKNOWN
        ends = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
        rows, columns = (slice(int(n[0]), int(n[-1]) + 1) if len(n) else slice(0, 0) for n in ends)
        return rows, columns

    @property
    def known_corners(self) -> NDArray[np.float64]:
        """Corners (4, 2) x, y, in cells, of the rectangle that holds all known cells; (0, 2) where none is."""
        rows, columns = self.known_span
        if rows.stop == rows.start:
            return np.zeros((0, 2))
        return np.array([(x, y) for x in (columns.start, columns.stop) for y in (rows.start, rows.stop)], float)

    def indices(self, points: ArrayLike) -> NDArray[np.int64]:
        """Return the (N, 2) row and column of the cells that hold (N, 2) points x, y; may lie outside."""
        local = planar.transform(planar.inverse(self.origin), points)
        return np.floor(local[:, ::-1] / self.resolution).astype(np.int64)

    def centres(self, rows: ArrayLike, columns: ArrayLike) -> NDArray[np.float64]:
        """Return the (N, 2) x, y of the middles of cells."""
        local = (np.column_stack([columns, rows]) + 0.5) * self.resolution
        return planar.transform(self.origin, local)
