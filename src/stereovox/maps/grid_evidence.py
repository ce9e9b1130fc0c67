# SPDX-License-Identifier: Apache-2.0
"""What one scan says about a floor, before any map knows it: beams make it, a grid adds it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SIDE = 64
"""Cells along each side of a tile."""
CELLS = SIDE * SIDE


@dataclass(frozen=True, eq=False)
class GridEvidence:
    """Log-odds of one scan in thousandths, tile by tile; no tile stands in it twice.

    coords: (n, 3) int32 tile coordinates x, y, 0: tile (0, 0) holds cells 0..63 on both axes.
    values: (n, 4096) int16 or int32; cell (column, row) of a tile stands at `64 row + column`. Zero where the scan says
        nothing.
    """

    coords: NDArray[np.int32]
    values: NDArray[np.signedinteger]

    @classmethod
    def nothing(cls) -> GridEvidence:
        """Return the evidence of a scan that says nothing."""
        return cls(np.empty((0, 3), np.int32), np.empty((0, CELLS), np.int16))

    def cells(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the cells it says something about: column and row (N, 2) in ascending order, thousandths (N,)."""
        tile, place = np.nonzero(self.values)
        indices = self.coords[tile, :2].astype(np.int64) * SIDE + np.column_stack([place % SIDE, place // SIDE])
        order = np.lexsort(indices.T[::-1])
        return indices[order], self.values[tile, place].astype(np.int64)[order]
