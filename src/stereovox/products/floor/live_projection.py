# SPDX-License-Identifier: Apache-2.0
"""A 3-D map seen from above, kept up to date while it is built: only changes are projected again."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic
from weakref import WeakMethod

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid, Percent
from stereovox.maps.storage.blocks import SIDE
from stereovox.maps.storage.rolling import RollingMap
from stereovox.maps.storage.storage import EVERYWHERE
from stereovox.products.floor.floor_axes import Heights, check_level, checked_band, floor_axes
from stereovox.products.floor.floor_heights import CURE, NO_FLOOR, FloorHeights, find_floor
from stereovox.products.floor.projection import patch_of, shown_percent

STEP = 8 * SIDE
"""The grid grows by this many cells, so that planners need not reallocate with each frame."""
MAX_CELLS = 2**26
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
        if columns * rows > MAX_CELLS:
            raise StereovoxError(f"a grid of {columns} x {rows} cells is too large; set window.size=[X,Y,Z]")
        larger, (left, bottom) = np.full((rows, columns), UNKNOWN, np.int8), (self.corner - low).tolist()
        if self.cells.size:
            larger[bottom : bottom + self.cells.shape[0], left : left + self.cells.shape[1]] = self.cells
        self.corner, self.cells = low, larger
