# SPDX-License-Identifier: Apache-2.0
"""Truth map prepared for scoring other maps."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.cells import Keys, indices, keys, position
from stereovox.evaluate.metrics import known_cells
from stereovox.maps import State, VoxelMap
from stereovox.maps.cubes import in_cubes

_STEPS: tuple[int, ...] = tuple((keys(np.eye(3, dtype=int)) - keys([0, 0, 0])).tolist())
"""Difference of keys by one cell along x, y and z."""
_FARTHEST_BLOCK = 1 << 17
"""Keys cannot hold blocks beyond."""
MAX_TOLERANCE = 20
_ROUNDING = 1e-6
"""Log-odds are stored in steps of about a thousandth: closer to a threshold counts as equal to it."""


class CellReader:
    """Reads the log-odds of a fixed set of cells from any kind of map.

    cells: the set, ascending keys (N,).
    """

    def __init__(self, cells: Keys):
        self.cells = cells
        cell = indices(cells)
        low = cell & 7
        self._blocks, of_cell = np.unique(keys(cell >> 3), return_inverse=True)
        self._place = (of_cell << 9) | (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]

    def log_odds(self, voxel_map: VoxelMap) -> NDArray[np.float32]:
        """Return the log-odds (N,) of the cells in the order of their keys; exactly 0 where unobserved."""
        kind = voxel_map.storage.cell_format
        stored = np.full((len(self._blocks), 512), kind.unknown, kind.dtype)
        for coords, values in voxel_map.storage.slabs():
            row = position(keys(coords), self._blocks)
            here = (row >= 0) & (np.abs(coords) < _FARTHEST_BLOCK).all(axis=1)
            stored[row[here]] = values[here]
        return kind.log_odds(stored.ravel()[self._place])


class Neighbourhood:
    """All cells within `tolerance` cells, along every axis, of a fixed set of cells.

    cells: the set, ascending keys (S,); around: all cells within reach, including the set, ascending keys (D,).
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


@dataclass(frozen=True, eq=False)
class Reading:
    """Values of a map in the cells of the truth.

    log_odds: (N,) float32 of each cell of the truth, 0 where unobserved. best: (S,) float32, for each truly occupied
    cell the highest log-odds of the map within the tolerance, -inf where all is unobserved.
    """

    log_odds: NDArray[np.float32]
    best: NDArray[np.float32]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Cells (N,) that the map has observed."""
        return self.log_odds != 0

    @property
    def probability(self) -> NDArray[np.float64]:
        """Probability (N,) that each cell is occupied, 0.5 where unobserved."""
        return 1 / (1 + np.exp(-self.log_odds.astype(float)))

    def marked(self, threshold: float) -> NDArray[np.bool_]:
        """Cells (N,) the map calls occupied, p > threshold (Valenti 2018, Eq 8.1); never an unobserved one."""
        return (self.log_odds > level(threshold)) & self.observed

    def found(self, threshold: float) -> NDArray[np.bool_]:
        """Truly occupied cells (S,) that have a cell with p > threshold within the tolerance."""
        return self.best > level(threshold)


class TruthCells:
    """The cells of a truth map that count, and what lies within `tolerance` cells of its surfaces.

    truth_map: its occupied cells hold a surface, its free cells were in view and hold none; all others, tentative ones
    too, do not count. cells: ascending keys (N,) of those that count; occupied: (N,) which of them hold a surface;
    near: (N,) which have a surface within the tolerance. Distances count along each axis: diagonal neighbours are one
    cell away. Raises StereovoxError for a truth without such cells and an invalid tolerance.
    """

    def __init__(self, truth_map: VoxelMap, tolerance: int = 1):
        truth_map = in_cubes(truth_map)
        if not 0 <= tolerance <= MAX_TOLERANCE:
            raise StereovoxError(f"tolerance {tolerance} is out of range; give 0 to {MAX_TOLERANCE} cells")
        known, state = known_cells(truth_map)
        counts = (state == State.OCCUPIED) | (state == State.FREE)
        if not counts.any():
            raise StereovoxError("the truth holds no occupied and no free cell; make it with stereovox truth")
        self.voxel_size, self.tolerance, self.up = truth_map.voxel_size, tolerance, truth_map.config.up
        self.cells: Keys = known[counts]
        self.occupied: NDArray[np.bool_] = state[counts] == State.OCCUPIED
        self._neighbourhood = Neighbourhood(self.cells[self.occupied], tolerance)
        around = self._neighbourhood.around
        self.near: NDArray[np.bool_] = position(self.cells, around) >= 0
        self._reader = CellReader(np.union1d(self.cells, around))
        self._own = np.searchsorted(self._reader.cells, self.cells)
        self._around = np.searchsorted(self._reader.cells, around)
        self._surface = np.arange(len(self._neighbourhood.cells))

    def part(self, chosen: NDArray[np.bool_]) -> TruthCells:
        """Return the truth of the `chosen` cells (N,) alone; what lies near them counts as near, chosen or not.

        Raises StereovoxError where none is chosen.
        """
        if not chosen.any():
            raise StereovoxError("no cell of the truth lies in this part of it; choose a larger one")
        part = copy(self)
        part.cells, part.occupied, part.near = self.cells[chosen], self.occupied[chosen], self.near[chosen]
        part._own, part._surface = self._own[chosen], self._surface[chosen[self.occupied]]
        return part

    def read(self, voxel_map: VoxelMap) -> Reading:
        """Read `voxel_map`. Raises StereovoxError where its cells are not those of the truth."""
        voxel_map = in_cubes(voxel_map)
        if not np.allclose(voxel_map.voxel_size, self.voxel_size, rtol=1e-5, atol=0):
            raise StereovoxError(
                f"cells of {voxel_map.voxel_size:g} m cannot be compared with a truth of {self.voxel_size:g} m; "
                "make both with the same --voxel-size"
            )
        log_odds = self._reader.log_odds(voxel_map)
        around = log_odds[self._around]
        best = self._neighbourhood.highest(np.where(around == 0, np.float32(-np.inf), around))
        return Reading(log_odds[self._own], best.astype(np.float32)[self._surface])

    def centers(self) -> NDArray[np.float64]:
        """Return the centres (N, 3) of the cells in metres, world frame."""
        return np.asarray((indices(self.cells) + 0.5) * self.voxel_size, float)


def level(threshold: float) -> float:
    """Return the log-odds that a cell must exceed to have p > threshold. Raises StereovoxError outside (0, 1)."""
    if not 0 < threshold < 1:
        raise StereovoxError(f"threshold {threshold} is not a probability between 0 and 1; the usual one is 0.7")
    return log(threshold / (1 - threshold)) + _ROUNDING
