# SPDX-License-Identifier: Apache-2.0
"""A map of the truth, made ready to judge other maps by it."""

from __future__ import annotations

from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.cell_reader import CellReader, Neighbourhood
from stereovox.evaluate.cells import Keys, indices, position
from stereovox.evaluate.metrics import known_cells
from stereovox.maps import State, VoxelMap
from stereovox.maps.cubes import in_cubes

MOST_TOLERANCE = 20
_ROUNDING = 1e-6
"""Log-odds are kept in steps of about a thousandth: what is nearer to a threshold than this is equal to it."""


@dataclass(frozen=True, eq=False)
class Reading:
    """What a map says about the cells of the truth.

    log_odds: (N,) float32 of each cell of the truth, 0 where the map knows nothing. best: (S,) float32, for each truly
    occupied cell the highest log-odds that the map has within the tolerance, -inf where it knows nothing there.
    """

    log_odds: NDArray[np.float32]
    best: NDArray[np.float32]

    @property
    def observed(self) -> NDArray[np.bool_]:
        """Cells (N,) that the map knows something about."""
        return self.log_odds != 0

    @property
    def probability(self) -> NDArray[np.float64]:
        """Probability (N,) that each cell is occupied, 0.5 where the map knows nothing."""
        return 1 / (1 + np.exp(-self.log_odds.astype(float)))

    def marked(self, threshold: float) -> NDArray[np.bool_]:
        """Cells (N,) the map calls occupied, p > threshold (Valenti 2018, Eq 8.1); never one it knows nothing about."""
        return (self.log_odds > level(threshold)) & self.observed

    def found(self, threshold: float) -> NDArray[np.bool_]:
        """Truly occupied cells (S,) that have a cell with p > threshold within the tolerance."""
        return self.best > level(threshold)


class TruthCells:
    """The cells of a truth map that count, and what lies within `tolerance` cells of its surfaces.

    truth_map: its occupied cells hold a surface, its free cells were in view and hold none; all others, tentative ones
    too, are not judged. cells: ascending keys (N,) of those that count; occupied: (N,) which of them hold a surface;
    near: (N,) which have a surface within the tolerance. Distances count along each axis: diagonal neighbours are one
    cell away. Raises StereovoxError for a truth without such cells and a tolerance that is no number of cells.
    """

    def __init__(self, truth_map: VoxelMap, tolerance: int = 1):
        truth_map = in_cubes(truth_map)
        if not 0 <= tolerance <= MOST_TOLERANCE:
            raise StereovoxError(f"tolerance {tolerance} is out of range; give 0 to {MOST_TOLERANCE} cells")
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

    def read(self, voxel_map: VoxelMap) -> Reading:
        """Return what `voxel_map` says. Raises StereovoxError where its cells are not those of the truth."""
        voxel_map = in_cubes(voxel_map)
        if not np.allclose(voxel_map.voxel_size, self.voxel_size, rtol=1e-5, atol=0):
            raise StereovoxError(
                f"cells of {voxel_map.voxel_size:g} m cannot be compared with a truth of {self.voxel_size:g} m; "
                "make both with the same --voxel-size"
            )
        log_odds = self._reader.log_odds(voxel_map)
        around = log_odds[self._around]
        best = self._neighbourhood.highest(np.where(around == 0, np.float32(-np.inf), around))
        return Reading(log_odds[self._own], best.astype(np.float32))

    def centers(self) -> NDArray[np.float64]:
        """Return the centres (N, 3) of the cells in metres, world frame."""
        return np.asarray((indices(self.cells) + 0.5) * self.voxel_size, float)


def level(threshold: float) -> float:
    """Return the log-odds that a cell must exceed to have p > threshold. Raises StereovoxError outside (0, 1)."""
    if not 0 < threshold < 1:
        raise StereovoxError(f"threshold {threshold} is no probability between 0 and 1; the usual one is 0.7")
    return log(threshold / (1 - threshold)) + _ROUNDING
