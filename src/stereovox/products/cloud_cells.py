# SPDX-License-Identifier: Apache-2.0
"""Points of other programs as occupied cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.maps.blocks import blocks_of_cells
from stereovox.maps.queries import INDEX_LIMIT

MOST_BLOCKS = 2**19
"""Blocks of 8x8x8 cells, 1 KB each, that cells of a file may lie in: a file of far points is not to fill the memory."""


def cells_of_points(points: ArrayLike, voxel_size: float) -> VoxelMap:
    """Return a map of the default profile in which each cell that holds a point is occupied, all others unknown.

    points: (N, 3) metres, world frame; those that are not finite count for nothing. voxel_size: metres.
    Raises StereovoxError for points so far away that no cell can be there, for too many blocks, or a bad size.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    config = load_config(voxel_size=voxel_size)
    cells = np.floor(points[np.isfinite(points).all(axis=1)] / voxel_size)
    if (np.abs(cells) >= INDEX_LIMIT).any():
        raise StereovoxError(
            f"a point lies more than {INDEX_LIMIT * voxel_size:g} m away; check the unit, or use larger cells"
        )
    indices = cells.astype(np.int64)
    check_room(indices)
    return VoxelMap.from_cells(config, indices, np.full(len(indices), config.map.log_odds_max))


def check_room(indices: NDArray[np.integer]) -> None:
    """Raise StereovoxError where cells (N, 3) lie in more than `MOST_BLOCKS` blocks."""
    blocks = len(blocks_of_cells(indices)[0]) if len(indices) > MOST_BLOCKS else len(indices)
    if blocks > MOST_BLOCKS:
        raise StereovoxError(f"its cells lie in {blocks} blocks, more than {MOST_BLOCKS}; use larger cells or crop it")
