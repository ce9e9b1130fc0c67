# SPDX-License-Identifier: Apache-2.0
"""Obstacles grown by a robot's radius, so that it may be planned for as a point.

Chien 2020 (5): what is occupied may be one cell larger or smaller than the thing itself, therefore "a one cell margin
is required for path planning and obstacle avoidance".
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.guarded import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.products.transform import transformed

MARGIN = 1
"""Cells by which an obstacle may be larger than the map says."""
TILE = 64
"""Cells along each side of the boxes that a map is worked off in."""
TIE = 1e-6


def inflated_mask(
    blocked: NDArray[np.bool_], sides: ArrayLike, radius: float, margin: int = MARGIN
) -> NDArray[np.bool_]:
    """Return the cells in which a robot's middle may not be: (x, y, z) or (rows, columns) bool, as `blocked`.

    In all others it may stand anywhere in the cell: no obstacle is nearer than `radius` metres, even if each is larger
    by `margin` cells to all sides. sides: of a cell in metres, one for each axis. What is outside counts for nothing.
    Raises StereovoxError for a radius that is not above 0, or a margin below.
    """
    _check(radius, margin)
    shape = (1,) * (3 - blocked.ndim) + blocked.shape
    steps = np.concatenate([np.ones(3 - blocked.ndim), np.broadcast_to(sides, blocked.ndim)])
    gaps = transformed(blocked.reshape(shape), steps, max_distance=radius, nearer=1 + margin)
    return (gaps < radius * (1 - TIE)).reshape(blocked.shape)


def inflated_grid(grid: OccupancyGrid, radius: float, margin: int = MARGIN) -> OccupancyGrid:
    """Return a 2-D map with 100 per cent in all cells in which a robot of `radius` metres may not be.

    Occupied cells grow as in `inflated_mask`, over free, tentative and unknown ones; the picture does not.
    """
    near = inflated_mask(grid.states == State.OCCUPIED, grid.resolution, radius, margin)
    return replace(grid, cells=np.where(near, np.int8(100), grid.cells))


@one_state
def inflated(voxel_map: VoxelMap, radius: float, margin: int = MARGIN) -> VoxelMap:
    """Return a map without bounds in which all cells are occupied in which a robot of `radius` metres may not be.

    Occupied cells grow as in `inflated_mask`, over free, tentative and unknown ones. When cells were seen is not kept.
    """
    _check(radius, margin)
    known, log_odds = voxel_map.cells()
    tiles = _tiles(voxel_map.cells_in(State.OCCUPIED))
    grown = np.concatenate([known[:0], *(_grown(voxel_map, tile, radius, margin) for tile in tiles)])
    surest = np.full(len(grown), voxel_map.config.map.log_odds_max)
    made = VoxelMap.from_cells(voxel_map.config, np.concatenate([known, grown]), np.concatenate([log_odds, surest]))
    made.take_history(voxel_map)
    return made


def _tiles(cells: NDArray[np.int32]) -> list[NDArray[np.int32]]:
    """Return cells (N, 3) in groups that lie close together."""
    if not len(cells):
        return []
    _, of_cell, number = np.unique(cells // TILE, axis=0, return_inverse=True, return_counts=True)
    return np.split(cells[np.argsort(of_cell.ravel(), kind="stable")], np.cumsum(number)[:-1])


def _grown(voxel_map: VoxelMap, cells: NDArray[np.int32], radius: float, margin: int) -> NDArray[np.int32]:
    """Return all cells (M, 3) that are blocked by these (N, 3)."""
    reach = np.array([ceil(radius / side) + 1 + margin for side in voxel_map.config.cell])
    low = cells.min(axis=0) - reach
    blocked = np.zeros(cells.max(axis=0) + reach + 1 - low, bool)
    blocked[tuple((cells - low).T)] = True
    return (np.argwhere(inflated_mask(blocked, voxel_map.config.cell, radius, margin)) + low).astype(np.int32)


def _check(radius: float, margin: int) -> None:
    if not 0 < radius < np.inf:
        raise StereovoxError(f"radius {radius:g}: give the robot's radius, more than 0 m")
    if margin < 0:
        raise StereovoxError(f"margin {margin}: give a number of cells, 0 or more")
