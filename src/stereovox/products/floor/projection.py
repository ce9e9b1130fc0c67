# SPDX-License-Identifier: Apache-2.0
"""A 3-D map seen from above: the 2-D planning grid of a ground robot, and obstacles inflated by its radius.

Chien 2020 (5): occupied cells may reach one cell too far or not far enough, therefore "a one cell margin is required
for path planning and obstacle avoidance".
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid, Percent
from stereovox.maps.storage.blocks import SIDE
from stereovox.maps.storage.cubes import in_cubes
from stereovox.products.floor import _projection
from stereovox.products.floor.floor_axes import MAX_CELLS, Heights, check_level, checked_band, floor_axes
from stereovox.products.floor.floor_heights import FloorHeights, known_floor
from stereovox.products.transform import transformed

MARGIN = 1
"""Cells by which an obstacle may be larger than its occupied cells."""
TILE = 64
"""Cells along each side of the boxes in which a map is processed."""
INFLATE_TIE = 1e-6
EMPTY = np.iinfo(np.int16).min
"""Stored value of an unknown column; no cell has this value."""
NEVER = -1


@one_state
def project(
    voxel_map: VoxelMap,
    heights: Heights | None = None,
    floor: FloorHeights | float | None = None,
    start: ArrayLike | None = None,
) -> OccupancyGrid:
    """Return the map seen from above, just large enough for the known cells, as a robot on its floor needs it.

    Heights are measured above the floor at each place, never from the world's origin. A column has the largest
    probability of its known cells within the heights: an occupied one makes it occupied (a table top is no thicker), a
    tentative one keeps it from being free. It is free only if all its cells within the heights are known to be free,
    and the floor was observed within `floor_heights.REACH`. Otherwise it is unknown: a camera that never saw the top of
    the band does not clear it, so give the true height of a lower robot.

    The grid's x and y are the map's if z is up; else the two axes that make a right-handed frame with `up`: y and z
    for x, z and x for y, and with a minus the same two swapped. Uneven cells become cubes if the floor needs it.

    Args:
        voxel_map: The map.
        heights: Lowest and highest metres above the floor that a robot occupies; None: the map's own `scan.heights`.
        floor: Height of the floor at each place; a number states a level floor, in metres along the map's `up` from the
            world's origin; None: it is found.
        start: (3,) metres, near the wanted floor, if it is to be found; see `find_floor`.

    Returns:
        The grid. Cells above an unknown floor are unknown.

    Raises:
        StereovoxError: The floor is unknown, no cell within the heights is known, the grid is too large, or the map is
            not level.
    """
    check_level(voxel_map.config)
    heights = checked_band(heights or voxel_map.config.scan.heights)
    grid = from_above(voxel_map, heights, known_floor(voxel_map, floor, start))
    if grid is None:
        band = f"{heights[0]:g} to {heights[1]:g} m above the floor"
        raise StereovoxError(f"{band} no place is known to be free or occupied; give other heights")
    return grid


def from_above(voxel_map: VoxelMap, heights: Heights, floor: FloorHeights) -> OccupancyGrid | None:
    """Return the map seen from above, as `project`, of any `up`; None if nothing is known within the heights."""
    order = list(floor_axes(voxel_map.config.up)[:3])
    if voxel_map.config.cell[order[0]] != voxel_map.config.cell[order[1]]:
        voxel_map = in_cubes(voxel_map)
    slabs = (slab for slab in voxel_map.storage.slabs() if len(slab[0]))
    patch = _joined([patch_of(voxel_map, *slab, order, floor, heights) for slab in slabs])
    return None if patch is None else _grid(voxel_map, patch, voxel_map.config.cell[order[0]])


class Patch(NamedTuple):
    """Some blocks seen from above: lowest column and row, and arrays (rows, columns).

    marked, free: int16, as `look_down` fills them. wanted: int32, how many cells must be free for the column to be so;
    NEVER if its floor was not seen nearby.
    """

    corner: NDArray[np.int64]
    marked: NDArray[np.int16]
    free: NDArray[np.int16]
    wanted: NDArray[np.int32]


def patch_of(
    voxel_map: VoxelMap,
    coords: NDArray[np.int32],
    values: NDArray[np.integer],
    order: list[int],
    floor: FloorHeights,
    heights: Heights,
) -> Patch:
    """Return what blocks (n, 3), n > 0, with their cells (n, 512) as stored, look like from above.

    order: axes along columns, along rows and up, see `floor_axes`.
    """
    across = coords[:, order[:2]].astype(np.int64)
    low, high = across.min(axis=0) * SIDE, (across.max(axis=0) + 1) * SIDE
    check_size(low, high)
    first, last, near = floor.layers(low, high, voxel_map.config, heights)
    marked, free = np.full(first.shape, EMPTY, np.int16), np.zeros(first.shape, np.int16)
    rules = CellRules(voxel_map.config.map)
    _projection.look_down(
        coords, values, np.array(order), low, first, last, np.int16(rules.format.unknown),
        np.int16(ceil(rules.free_below)), marked, free,
    )  # fmt: skip
    return Patch(low, marked, free, np.where(near, last - first + 1, NEVER).astype(np.int32))


def shown_percent(patch: Patch, percent: Percent) -> NDArray[np.int8]:
    """Return the cells (rows, columns) of a grid: per cent occupied, -1 for unknown."""
    lowest = percent.lowest
    shown = percent.shown[np.maximum(patch.marked, lowest).astype(np.int32) - lowest]
    seen_free = patch.free == patch.wanted
    may_show = (shown >= 100 * percent.free_below) | seen_free
    return np.where((patch.marked != EMPTY) & may_show, shown, np.int8(UNKNOWN))


@one_state
def inflated(voxel_map: VoxelMap, radius: float, margin: int = MARGIN) -> VoxelMap:
    """Return an unbounded map in which all cells that a robot of `radius` metres must avoid are occupied.

    Occupied cells grow as in `inflated_mask`, over free, tentative and unknown ones. Cell times are not kept.
    """
    _check(radius, margin)
    known, log_odds = voxel_map.cells()
    tiles = _tiles(voxel_map.cells_in(State.OCCUPIED))
    grown = np.concatenate([known[:0], *(_grown(voxel_map, tile, radius, margin) for tile in tiles)])
    surest = np.full(len(grown), voxel_map.config.map.log_odds_max)
    made = VoxelMap.from_cells(voxel_map.config, np.concatenate([known, grown]), np.concatenate([log_odds, surest]))
    made.storage.take_history(voxel_map.storage)
    return made


def inflated_grid(grid: OccupancyGrid, radius: float, margin: int = MARGIN) -> OccupancyGrid:
    """Return a 2-D map with 100 per cent in all cells that a robot of `radius` metres must avoid.

    Occupied cells grow as in `inflated_mask`, over free, tentative and unknown ones; the grid keeps its size.
    """
    near = inflated_mask(grid.states == State.OCCUPIED, grid.resolution, radius, margin)
    return replace(grid, cells=np.where(near, np.int8(100), grid.cells))


def inflated_mask(
    blocked: NDArray[np.bool_], sides: ArrayLike, radius: float, margin: int = MARGIN
) -> NDArray[np.bool_]:
    """Return the cells that a robot's centre must avoid: (x, y, z) or (rows, columns) bool, as `blocked`.

    No point of the other cells is nearer than `radius` metres to an obstacle, even if each is larger by `margin` cells
    on all sides. sides: of a cell in metres, one per axis. Cells outside do not count. Raises StereovoxError for a
    radius that is not above 0 or a margin below 0.
    """
    _check(radius, margin)
    shape = (1,) * (3 - blocked.ndim) + blocked.shape
    steps = np.concatenate([np.ones(3 - blocked.ndim), np.broadcast_to(sides, blocked.ndim)])
    gaps = transformed(blocked.reshape(shape), steps, max_distance=radius, nearer=1 + margin)
    return (gaps < radius * (1 - INFLATE_TIE)).reshape(blocked.shape)


def _tiles(cells: NDArray[np.int32]) -> list[NDArray[np.int32]]:
    """Return cells (N, 3) in compact groups."""
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


def check_size(low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
    """Raise StereovoxError if a grid from column and row `low` to below `high` is too large."""
    columns, rows = (high - low).tolist()
    if columns * rows > MAX_CELLS:
        raise StereovoxError(
            f"a grid of {columns} x {rows} cells is too large; map a smaller place, with --set window.size=[X,Y,Z]"
        )


def _joined(patches: list[Patch]) -> Patch | None:
    if len(patches) < 2:
        return patches[0] if patches else None
    ends = [patch.corner + patch.marked.shape[::-1] for patch in patches]
    low, high = np.min([patch.corner for patch in patches], axis=0), np.max(ends, axis=0)
    check_size(low, high)
    shape = tuple((high - low)[::-1])
    joined = Patch(low, np.full(shape, EMPTY, np.int16), np.zeros(shape, np.int16), np.full(shape, NEVER, np.int32))
    for patch in patches:
        (left, bottom), (rows, columns) = (patch.corner - low).tolist(), patch.marked.shape
        here = slice(bottom, bottom + rows), slice(left, left + columns)
        joined.marked[here] = np.maximum(joined.marked[here], patch.marked)
        joined.free[here] += patch.free
        joined.wanted[here] = patch.wanted
    return joined


def _grid(voxel_map: VoxelMap, patch: Patch, side: float) -> OccupancyGrid | None:
    percent = Percent(CellRules(voxel_map.config.map))
    cells = shown_percent(patch, percent)
    rows, columns = (np.flatnonzero((cells != UNKNOWN).any(axis=across)) for across in (1, 0))
    if not len(rows):
        return None
    cells = cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    left, bottom = ((patch.corner + np.array([columns[0], rows[0]])) * side).round(9).tolist()
    return OccupancyGrid(cells, side, (left, bottom, 0.0), percent.free_below, percent.occupied_above)
