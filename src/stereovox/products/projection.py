# SPDX-License-Identifier: Apache-2.0
"""A 3-D map seen from above: the 2-D grid in which a ground robot plans, and obstacles inflated by a robot's radius.

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
from stereovox.maps import State, VoxelMap
from stereovox.maps.blocks import SIDE
from stereovox.maps.cell_format import CellRules
from stereovox.maps.cubes import in_cubes
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid, Percent
from stereovox.products import _projection
from stereovox.products.floor_axes import Heights, floor_axes
from stereovox.products.transform import transformed
from stereovox.threads import one_state

MARGIN = 1
"""Cells by which an obstacle may be larger than its occupied cells."""
TILE = 64
"""Cells along each side of the boxes in which a map is processed."""
INFLATE_TIE = 1e-6
EMPTY = np.iinfo(np.int16).min
"""Stored value of a column in which nothing is known; no cell is stored as this."""
MAX_CELLS = 2**30
"""Cells of the largest grid."""
TIE = 1e-9


@one_state
def project(voxel_map: VoxelMap, heights: Heights | None = None) -> OccupancyGrid:
    """Return the map seen from above, just large enough for what is known.

    heights: lowest and highest metres along the map's `up`, from the world's origin, between which a cell's centre
    marks; None: the map's own `scan.heights`.
    The heights only limit marking. A column has the largest probability of all its known cells between them: an
    occupied one makes it occupied (a table top is no thicker), one that is neither keeps it from being free. Where
    nothing between them is known, free cells at any other height clear the column, and it has the largest probability
    of those. Otherwise it is unknown.
    The grid's x and y are the map's where z is up; else the two axes that make a right-handed frame with `up`: y and z
    for x, z and x for y, and with a minus the same two swapped. Uneven cells become cubes where the floor needs it.
    Raises StereovoxError where no cell between the heights is known, for too large a grid, or a map that is not level.
    """
    check_level(voxel_map.config)
    order = list(floor_axes(voxel_map.config.up)[:3])
    if voxel_map.config.cell[order[0]] != voxel_map.config.cell[order[1]]:
        voxel_map = in_cubes(voxel_map)
    heights = heights or voxel_map.config.scan.heights
    layers = layers_of(voxel_map, order[2], heights)
    patches = [patch_of(voxel_map, *slab, order, layers) for slab in voxel_map.storage.slabs() if len(slab[0])]
    patch = _joined(patches)
    if patch is None or not (patch.marked != EMPTY).any():
        raise StereovoxError(_format_empty(voxel_map, order[2], heights))
    return _grid(voxel_map, patch, voxel_map.config.cell[order[0]])


class Patch(NamedTuple):
    """Some blocks seen from above: lowest column and row, and (rows, columns) int16 as `look_down` fills them."""

    corner: NDArray[np.int64]
    marked: NDArray[np.int16]
    cleared: NDArray[np.int16]


def patch_of(
    voxel_map: VoxelMap,
    coords: NDArray[np.int32],
    values: NDArray[np.integer],
    order: list[int],
    layers: NDArray[np.int64],
) -> Patch:
    """Return what blocks (n, 3), n > 0, with their cells (n, 512) as stored, show from above.

    order: axes along columns, along rows and up, see `floor_axes`; layers: as `layers_of` returns them.
    """
    floor = coords[:, order[:2]].astype(np.int64)
    low, high = floor.min(axis=0) * SIDE, (floor.max(axis=0) + 1) * SIDE
    patch = _empty(low, high)
    rules = CellRules(voxel_map.config.map)
    _projection.look_down(
        np.ascontiguousarray(coords), np.ascontiguousarray(values), np.array(order), low, layers,
        np.int16(rules.format.unknown), np.int16(np.ceil(rules.free_below)), patch.marked, patch.cleared,
    )  # fmt: skip
    return patch


def layers_of(voxel_map: VoxelMap, axis: int, heights: Heights) -> NDArray[np.int64]:
    """Return the first and the last layer of cells whose middle is above the lower height, and not above the upper."""
    low, high = heights
    if not (np.isfinite(heights).all() and low < high):
        raise StereovoxError(f"heights {low:g}:{high:g} must be two numbers that rise, LO:HI in metres")
    step = voxel_map.config.cell[axis]
    below, top = np.floor(np.array(heights) / step - 0.5 + TIE)
    layers = np.clip([below + 1, top], -(2.0**40), 2.0**40).astype(np.int64)
    if layers[0] > layers[1]:
        raise StereovoxError(f"heights {low:g}:{high:g} hold the middle of no cell of {step:g} m; widen them")
    return -1 - layers[::-1] if voxel_map.config.up.startswith("-") else layers


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

    Anywhere in the other cells no obstacle is nearer than `radius` metres, even if each is larger by `margin` cells on
    all sides. sides: of a cell in metres, one per axis. What is outside counts for nothing. Raises StereovoxError for a
    radius that is not above 0 or a margin below 0.
    """
    _check(radius, margin)
    shape = (1,) * (3 - blocked.ndim) + blocked.shape
    steps = np.concatenate([np.ones(3 - blocked.ndim), np.broadcast_to(sides, blocked.ndim)])
    gaps = transformed(blocked.reshape(shape), steps, max_distance=radius, nearer=1 + margin)
    return (gaps < radius * (1 - INFLATE_TIE)).reshape(blocked.shape)


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


def _empty(low: NDArray[np.int64], high: NDArray[np.int64]) -> Patch:
    columns, rows = (high - low).tolist()
    if columns * rows > MAX_CELLS:
        raise StereovoxError(
            f"a grid of {columns} x {rows} cells is too large; map a smaller place, with --set window.size=[X,Y,Z]"
        )
    return Patch(low, np.full((rows, columns), EMPTY, np.int16), np.full((rows, columns), EMPTY, np.int16))


def _joined(patches: list[Patch]) -> Patch | None:
    if len(patches) < 2:
        return patches[0] if patches else None
    ends = [patch.corner + patch.marked.shape[::-1] for patch in patches]
    joined = _empty(np.min([patch.corner for patch in patches], axis=0), np.max(ends, axis=0))
    for patch in patches:
        (left, bottom), (rows, columns) = (patch.corner - joined.corner).tolist(), patch.marked.shape
        here = slice(bottom, bottom + rows), slice(left, left + columns)
        for whole, part in ((joined.marked, patch.marked), (joined.cleared, patch.cleared)):
            whole[here] = np.maximum(whole[here], part)
    return joined


def _grid(voxel_map: VoxelMap, patch: Patch, side: float) -> OccupancyGrid:
    number = np.where(patch.marked != EMPTY, patch.marked, patch.cleared)
    rows, columns = (np.flatnonzero((number != EMPTY).any(axis=across)) for across in (1, 0))
    number = number[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    percent = Percent(CellRules(voxel_map.config.map))
    known = percent.shown[np.maximum(number, percent.lowest).astype(np.int32) - percent.lowest]
    left, bottom = ((patch.corner + np.array([columns[0], rows[0]])) * side).round(9).tolist()
    return OccupancyGrid(
        np.where(number == EMPTY, np.int8(UNKNOWN), known), side, (left, bottom, 0.0),
        percent.free_below, percent.occupied_above,
    )  # fmt: skip


def _format_empty(voxel_map: VoxelMap, axis: int, heights: Heights) -> str:
    bounds = voxel_map.bounds()
    if bounds is None:
        return "the map is empty: there is nothing to project"
    low, high = bounds[:, axis] if not voxel_map.config.up.startswith("-") else -bounds[::-1, axis]
    between = f"nothing is known at heights {heights[0]:g} to {heights[1]:g} m"
    return f"{between}, the map's own are {low:.2f} to {high:.2f} m; choose others with --heights=LO:HI"
