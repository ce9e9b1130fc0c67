# SPDX-License-Identifier: Apache-2.0
"""A 3-D map seen from above: the 2-D planning grid of a ground robot, and obstacles inflated by its radius.

Chien 2020 (5): occupied cells may reach one cell too far or not far enough, therefore "a one cell margin is required
for path planning and obstacle avoidance".

A 3-D map seen from above, kept up to date while it is built: only changes are projected again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import ceil
from time import monotonic
from typing import NamedTuple
from weakref import WeakMethod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid, Percent
from stereovox.maps.storage.blocks import SIDE
from stereovox.maps.storage.cubes import in_cubes
from stereovox.maps.storage.rolling import RollingMap
from stereovox.maps.storage.storage import EVERYWHERE
from stereovox.products import _projection
from stereovox.products.distance import transformed
from stereovox.products.floor_axes import MAX_CELLS, Heights, check_level, checked_band, floor_axes
from stereovox.products.floor_heights import CURE, NO_FLOOR, FloorHeights, find_floor, known_floor

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


STEP = 8 * SIDE
"""The grid grows by this many cells, so that planners need not reallocate with each frame."""
MAX_LIVE_CELLS = 2**26
"""Cells of the largest grid; more is too much to send with each frame."""


FLOOR_S = 1.0
"""Seconds between two searches for the floor."""
SHARE = 10.0
"""The next search waits this many times as long as the last one took."""
TOLD_AFTER = 3
"""Searches without a floor after which the user is informed."""


class LiveProjection:
    """Projects a map from above, as `projection.project`, at the cost of what changed.

    The floor is searched again at most every `floor_s` seconds, and takes at most a tenth of the time; places whose
    floor moved are projected again. While no floor is known, every cell is unknown. The grid covers the known region,
    in steps of 64 cells. Of a map in a window only the cells in memory count; such a map, and one that forgets, is
    projected as a whole each time.

    Args:
        voxel_map: The map.
        heights: As for `project`.
        floor: Metres along the map's `up` of a floor stated to be level; None: as `scan.floor` states, or else
            it is found.
        floor_s: Seconds between two searches for the floor.
        notify: Called once with a line if the map remains without a floor.
        clock: Monotonic seconds.

    Raises:
        StereovoxError: The heights make no sense, cells are not as long as wide, or the map is not level.
    """

    def __init__(
        self,
        voxel_map: VoxelMap,
        heights: Heights | None = None,
        floor: float | None = None,
        floor_s: float = FLOOR_S,
        notify: Callable[[str], None] = lambda line: None,
        clock: Callable[[], float] = monotonic,
    ):
        check_level(voxel_map.config)
        self._map, config = voxel_map, voxel_map.config
        self._order = list(floor_axes(config.up)[:3])
        across, along, _ = self._order
        if config.cell[across] != config.cell[along]:
            raise StereovoxError(f"steps {list(config.cell)}: a grid of the floor needs cells as long as wide")
        floor = config.scan.floor if floor is None else floor
        self._heights = checked_band(heights or config.scan.heights)
        self._floor = FloorHeights.unknown(config.up) if floor is None else FloorHeights.level(floor, config.up)
        self._floor_s, self._notify, self._clock = floor_s, notify, clock
        self._due, self._tries, self._seek = -np.inf, 0, floor is None
        self._stated = floor is not None
        self._percent = Percent(CellRules(config.map))
        self._whole = isinstance(voxel_map, RollingMap) or config.map.forget_s is not None
        self._changed = EVERYWHERE.copy()
        self._canvas = _Canvas()
        note = WeakMethod(self._note)  # the map must not keep its observer alive
        voxel_map.storage.listeners.append(lambda evidence: (method := note()) and method(evidence))

    @property
    def floor(self) -> FloorHeights:
        """The floor that heights were last measured from."""
        return self._floor

    def grid(self, last: bool = False) -> OccupancyGrid | None:
        """Return the current map from above, None if nothing is known. Its cells are a copy.

        last: find the floor in what the map has become, even if it was found less than `floor_s` ago. Raises
        StereovoxError for too large a grid.
        """
        with self._map.lock:  # `_note` is called with it held
            if last:
                self._due = -np.inf
            self._seek_floor()
            return self._grid()

    def _seek_floor(self) -> None:
        """Find the floor if due and the map changed, and record where it moved."""
        now = self._clock()
        if self._stated or not self._seek or now < self._due:
            return
        self._seek = False
        before, self._floor = self._floor, find_floor(self._map)
        self._due = now + max(self._floor_s, SHARE * (self._clock() - now))
        self._tries = 0 if self._floor.known else self._tries + 1
        if self._tries == TOLD_AFTER:
            self._notify(f"{NO_FLOOR}; {CURE}")
        if moved := self._floor.moved_from(before):
            low, high = moved
            here = self._order[:2]
            self._changed[0, here] = np.minimum(self._changed[0, here], low // SIDE)
            self._changed[1, here] = np.maximum(self._changed[1, here], -(-high // SIDE))
            self._changed[:, self._order[2]] = EVERYWHERE[:, self._order[2]]

    def _note(self, evidence: Evidence) -> None:
        """Mark the columns that a frame changed for projection."""
        self._seek = True
        for coords in (evidence.coords, evidence.uniform):
            if len(coords):
                floor = coords[:, self._order[:2]]
                low, high = self._changed
                low[self._order[:2]] = np.minimum(low[self._order[:2]], floor.min(axis=0))
                high[self._order[:2]] = np.maximum(high[self._order[:2]], floor.max(axis=0) + 1)
                low[self._order[2]], high[self._order[2]] = EVERYWHERE[:, 0]

    def _grid(self) -> OccupancyGrid | None:
        if self._whole:
            self._changed, self._canvas = EVERYWHERE.copy(), _Canvas()
        coords, cells = self._map.storage.blocks_within(*self._changed)
        self._canvas.clear(*(SIDE * self._changed[:, self._order[:2]]))  # corrections remove blocks
        if len(coords):
            floor = SIDE * coords[:, self._order[:2]].astype(np.int64)
            self._canvas.reach(floor.min(axis=0), floor.max(axis=0) + SIDE)
            patch = patch_of(self._map, coords, cells, self._order, self._floor, self._heights)
            self._canvas.paint(shown_percent(patch, self._percent), patch.corner)
        self._changed = EVERYWHERE[::-1].copy()
        return self._shown()

    def _shown(self) -> OccupancyGrid | None:
        if not self._canvas.cells.size:
            return None
        side = self._map.config.cell[self._order[0]]
        left, bottom = (self._canvas.corner * side).round(9).tolist()
        limits = self._percent.free_below, self._percent.occupied_above
        return OccupancyGrid(self._canvas.cells.copy(), side, (left, bottom, 0.0), *limits)


class _Canvas:
    """A growing image. corner: column and row of its first cell; cells: (rows, columns) int8 per cent."""

    def __init__(self) -> None:
        self.corner = np.zeros(2, np.int64)
        self.cells = np.empty((0, 0), np.int8)

    def paint(self, patch: NDArray[np.int8], corner: NDArray[np.int64]) -> None:
        """Overwrite a part of the canvas with a patch inside it."""
        left, bottom = (corner - self.corner).tolist()
        self.cells[bottom : bottom + patch.shape[0], left : left + patch.shape[1]] = patch

    def clear(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        """Make columns and rows from `low` to below `high` unknown, as far as they are on the canvas."""
        size = self.cells.shape[::-1]
        (left, bottom), (right, top) = (np.clip(end - self.corner, 0, size).tolist() for end in (low, high))
        self.cells[bottom:top, left:right] = UNKNOWN

    def reach(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
        """Grow by whole steps to cover columns and rows from `low` to below `high`; raises StereovoxError."""
        low, high = low // STEP * STEP, -(-high // STEP) * STEP
        if self.cells.size:
            before = self.corner + self.cells.shape[::-1]
            low, high = np.minimum(low, self.corner), np.maximum(high, before)
            if (low == self.corner).all() and (high == before).all():
                return
        columns, rows = (high - low).tolist()
        if columns * rows > MAX_LIVE_CELLS:
            raise StereovoxError(f"a grid of {columns} x {rows} cells is too large; set window.size=[X,Y,Z]")
        larger, (left, bottom) = np.full((rows, columns), UNKNOWN, np.int8), (self.corner - low).tolist()
        if self.cells.size:
            larger[bottom : bottom + self.cells.shape[0], left : left + self.cells.shape[1]] = self.cells
        self.corner, self.cells = low, larger
