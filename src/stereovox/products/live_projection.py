# SPDX-License-Identifier: Apache-2.0
"""A 3-D map seen from above, kept up to date while it is built: only what changed is projected again."""

from __future__ import annotations

from weakref import WeakMethod

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.maps.blocks import SIDE
from stereovox.maps.cell_format import CellRules
from stereovox.maps.evidence import Evidence
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid, Percent
from stereovox.maps.rolling import RollingMap
from stereovox.maps.storage import EVERYWHERE
from stereovox.products.floor_axes import Heights, floor_axes
from stereovox.products.projection import EMPTY, Patch, check_level, layers_of, patch_of

STEP = 8 * SIDE
"""The grid grows by this many cells, so that planners need not reallocate with each frame."""
MAX_CELLS = 2**26
"""Cells of the largest grid; more is too much to send with each frame."""


class LiveProjection:
    """Projects a map from above, as `projection.project`, at the cost of what changed.

    heights: as for `project`. The grid covers what is known, in steps of 64 cells. Of a map in a window only the cells
    in memory count; such a map, and one that forgets, is projected as a whole each time. Raises StereovoxError where
    the heights hold no cell, where cells are not as long as wide, and for a map that is not level.
    """

    def __init__(self, voxel_map: VoxelMap, heights: Heights | None = None):
        check_level(voxel_map.config)
        self._map, config = voxel_map, voxel_map.config
        self._order = list(floor_axes(config.up)[:3])
        across, along, up = self._order
        if config.cell[across] != config.cell[along]:
            raise StereovoxError(f"steps {list(config.cell)}: a grid of the floor needs cells as long as wide")
        self._layers = layers_of(voxel_map, up, heights or config.scan.heights)
        self._percent = Percent(CellRules(config.map))
        self._whole = isinstance(voxel_map, RollingMap) or config.map.forget_s is not None
        self._changed = EVERYWHERE.copy()
        self._canvas = _Canvas()
        note = WeakMethod(self._note)  # the map does not keep alive what only looks at it
        voxel_map.storage.listeners.append(lambda evidence: (method := note()) and method(evidence))

    def grid(self) -> OccupancyGrid | None:
        """Return the current map from above, None where nothing is known. Its cells are a copy.

        Raises StereovoxError for too large a grid.
        """
        with self._map.lock:  # `_note` is called with it held
            return self._grid()

    def _note(self, evidence: Evidence) -> None:
        """Add the columns that a frame changed to those to be projected again."""
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
        self._canvas.clear(*(SIDE * self._changed[:, self._order[:2]]))  # corrections take blocks away
        if len(coords):
            floor = SIDE * coords[:, self._order[:2]].astype(np.int64)
            self._canvas.reach(floor.min(axis=0), floor.max(axis=0) + SIDE)
            patch = patch_of(self._map, coords, cells, self._order, self._layers)
            self._canvas.paint(self._in_percent(patch), patch.corner)
        self._changed = EVERYWHERE[::-1].copy()
        return self._shown()

    def _in_percent(self, patch: Patch) -> NDArray[np.int8]:
        number = np.where(patch.marked != EMPTY, patch.marked, patch.cleared).astype(np.int32)
        known = self._percent.shown[np.maximum(number, self._percent.lowest) - self._percent.lowest]
        return np.where(number == EMPTY, np.int8(UNKNOWN), known)

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
        """Overwrite a part of the canvas with a patch that lies inside it."""
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
