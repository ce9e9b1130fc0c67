# SPDX-License-Identifier: Apache-2.0
"""Read the same cells from one map after another, and look for the best of their neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.cells import Keys, indices, keys, position
from stereovox.maps import VoxelMap

_STEPS: tuple[int, ...] = tuple((keys(np.eye(3, dtype=int)) - keys([0, 0, 0])).tolist())
"""How much a key grows by one cell along x, y and z."""
_FARTHEST_BLOCK = 1 << 17
"""Keys know no block beyond."""


class CellReader:
    """Reads the log-odds of a fixed set of cells, whatever kind of map holds them.

    cells: the set, ascending keys (N,).
    """

    def __init__(self, cells: Keys):
        self.cells = cells
        cell = indices(cells)
        low = cell & 7
        self._blocks, of_cell = np.unique(keys(cell >> 3), return_inverse=True)
        self._place = (of_cell << 9) | (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]

    def log_odds(self, voxel_map: VoxelMap) -> NDArray[np.float32]:
        """Return the log-odds (N,) of the cells in the order of their keys; exactly 0 where the map knows nothing."""
        kind = voxel_map.cell_format
        stored = np.full((len(self._blocks), 512), kind.unknown, kind.dtype)
        for coords, values in voxel_map.slabs():
            row = position(keys(coords), self._blocks)
            here = (row >= 0) & (np.abs(coords) < _FARTHEST_BLOCK).all(axis=1)
            stored[row[here]] = values[here]
        return kind.log_odds(stored.ravel()[self._place])


class Neighbourhood:
    """All cells at most `tolerance` cells away, along every axis, from a fixed set of cells.

    cells: the set, ascending keys (S,); around: all cells within reach, the set's own with them, ascending keys (D,).
    """

    def __init__(self, cells: Keys, tolerance: int):
        self.cells, self.around = cells, cells
        self._tables: list[NDArray[np.int64]] = []
        reach = np.arange(-tolerance, tolerance + 1)
        for step in _STEPS:  # one axis after the other: three short tables instead of one of (2 tolerance + 1)^3
            near = self.around[:, None] + step * reach
            self.around = np.unique(near)
            self._tables.append(np.searchsorted(self.around, near))

    def highest(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return for each cell (S,) the highest of the `values` (D,) of the cells within its reach."""
        for table in reversed(self._tables):
            values = values[table].max(axis=1)
        return values
