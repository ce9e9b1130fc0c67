# SPDX-License-Identifier: Apache-2.0
"""Evidence of one frame or scan, made by integrators and added to a map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SIDE = 64
"""Cells along each side of a tile."""
CELLS = SIDE * SIDE


@dataclass(frozen=True, eq=False)
class GridEvidence:
    """Log-odds of one scan in thousandths, tile by tile; each tile occurs once.

    coords: (n, 3) int32 tile coordinates x, y, 0: tile (0, 0) holds cells 0..63 on both axes.
    values: (n, 4096) int16 or int32; cell (column, row) of a tile is at `64 row + column`. Zero if the scan says
        nothing.
    ends: (N, 6) of each beam of the scan from where and up to where it clears, and where it hits, x and y in cells of
        the grid; NaN for nothing. None if unknown.
    weak, again: as in `Evidence`.
    """

    coords: NDArray[np.int32]
    values: NDArray[np.signedinteger]
    ends: NDArray[np.float64] | None = None
    weak: bool = False
    again: bool = False

    @classmethod
    def nothing(cls) -> GridEvidence:
        """Return empty evidence."""
        return cls(np.empty((0, 3), np.int32), np.empty((0, CELLS), np.int16))

    def cells(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the cells with evidence: column and row (N, 2) in ascending order, thousandths (N,)."""
        tile, place = np.nonzero(self.values)
        indices = self.coords[tile, :2].astype(np.int64) * SIDE + np.column_stack([place % SIDE, place // SIDE])
        order = np.lexsort(indices.T[::-1])
        return indices[order], self.values[tile, place].astype(np.int64)[order]


LOG_ODDS_SCALE = 1000
"""Log-odds are kept as whole thousandths; zero means "unknown"."""
LARGEST = 32767


def to_units(log_odds: float | NDArray[np.floating]) -> NDArray[np.int32]:
    """Return log-odds as whole thousandths that fit into 16 bits."""
    return np.clip(np.rint(np.asarray(log_odds) * LOG_ODDS_SCALE), -LARGEST, LARGEST).astype(np.int32)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Log-odds of one frame in thousandths, block by block; each block occurs once.

    coords: (n, 3) int32 block coordinates; values: (n, 512) int16, zero if the frame says nothing.
    uniform: (m, 3) int32 wholly free blocks; uniform_values: (m,) int16, negative, the evidence for every cell of each
        block.
    weak: whether it yields to the map: what is surely occupied is not cleared by it, and no occupied cell confirmed.
    again: whether it repeats what was added before: it then only takes free cells back, until they are not free.
    """

    coords: NDArray[np.int32]
    values: NDArray[np.int16]
    uniform: NDArray[np.int32]
    uniform_values: NDArray[np.int16]
    weak: bool = False
    again: bool = False

    def __post_init__(self) -> None:
        if np.ndim(self.uniform_values) == 0:
            object.__setattr__(self, "uniform_values", np.full(len(self.uniform), self.uniform_values, np.int16))
