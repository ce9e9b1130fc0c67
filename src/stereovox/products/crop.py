# SPDX-License-Identifier: Apache-2.0
"""The part of a map that lies in a box."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.maps.blocks import CELLS, SIDE
from stereovox.products.side_by_side import take
from stereovox.threads import one_state


@one_state
def crop(voxel_map: VoxelMap, low: ArrayLike, high: ArrayLike) -> VoxelMap:
    """Return an unbounded map of the cells whose middle is in a box, with the settings and the history of the map.

    low, high: corners (3,) in metres, world frame, of which `low` is part of the box; infinite where there is no end.
    Boxes that share a face share no cell and leave none out. Raises StereovoxError where `high` is not above `low`.
    """
    sides = np.array(voxel_map.config.cell)
    first, beyond = (np.ceil(corner / sides - 0.5) for corner in corners_of(low, high))
    cropped = VoxelMap(voxel_map.config)
    for coords, cells in voxel_map.storage.slabs():
        touched = ((coords * SIDE < beyond) & ((coords + 1) * SIDE > first)).all(axis=1)
        coords, cells = coords[touched], cells[touched]
        inside = _inside(coords, first, beyond)
        take(
            cropped, voxel_map, coords, np.where(inside, cells, cells.dtype.type(voxel_map.storage.cell_format.unknown))
        )
    cropped.storage.take_history(voxel_map.storage)
    return cropped


def corners_of(low: ArrayLike, high: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners (3,) of a box; raises StereovoxError where they are no corners."""
    corners = np.asarray(low, float), np.asarray(high, float)
    if corners[0].shape != (3,) or corners[1].shape != (3,) or not (corners[0] < corners[1]).all():
        raise StereovoxError(f"box from {low} to {high}: give two corners X, Y, Z, the second above the first on each")
    return corners


def _inside(coords: NDArray[np.int32], first: NDArray[np.float64], beyond: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which cells (n, 512) of blocks (n, 3) have indices in [first, beyond)."""
    numbers = coords[:, :, None] * SIDE + np.arange(SIDE)
    x, y, z = ((numbers >= first[:, None]) & (numbers < beyond[:, None])).swapaxes(0, 1)
    return (x[:, :, None, None] & y[:, None, :, None] & z[:, None, None, :]).reshape(-1, CELLS)
