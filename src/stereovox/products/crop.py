# SPDX-License-Identifier: Apache-2.0
"""The part of a map inside a box."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.kernels.threads import one_state
from stereovox.maps import VoxelMap
from stereovox.maps.storage.blocks import CELLS, SIDE
from stereovox.maps.storage.storage import EVERYWHERE
from stereovox.products.block_pairs import add_blocks


@one_state
def crop(voxel_map: VoxelMap, low: ArrayLike, high: ArrayLike) -> VoxelMap:
    """Keep the cells whose centre lies in a box.

    Boxes that share a face share no cell and leave none out.

    Args:
        voxel_map: The map.
        low: Lowest corner (3,) in metres, world frame, inclusive; -inf for no limit.
        high: Highest corner (3,), exclusive; inf for no limit.

    Returns:
        An unbounded map with the settings and the history of `voxel_map`.

    Raises:
        StereovoxError: `high` is not above `low`.
    """
    sides = np.array(voxel_map.config.cell)
    first, beyond = (np.ceil(corner / sides - 0.5) for corner in corners_of(low, high))
    cropped = VoxelMap(voxel_map.config)
    ends = np.clip([np.floor(first / SIDE), np.ceil(beyond / SIDE)], *EVERYWHERE[:, :1]).astype(np.int64)
    for coords, cells in voxel_map.storage.slabs_within(*ends):
        inside = _inside(coords, first, beyond)
        add_blocks(
            cropped, voxel_map, coords, np.where(inside, cells, cells.dtype.type(voxel_map.storage.cell_format.unknown))
        )
    cropped.storage.take_history(voxel_map.storage)
    return cropped


def corners_of(low: ArrayLike, high: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Validate the corners (3,) of a box; raises StereovoxError if they are invalid."""
    corners = np.asarray(low, float), np.asarray(high, float)
    if corners[0].shape != (3,) or corners[1].shape != (3,) or not (corners[0] < corners[1]).all():
        raise StereovoxError(f"box from {low} to {high}: give two corners X, Y, Z, the second above the first on each")
    return corners


def _inside(coords: NDArray[np.int32], first: NDArray[np.float64], beyond: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which cells (n, 512) of blocks (n, 3) have indices in [first, beyond)."""
    numbers = coords[:, :, None] * SIDE + np.arange(SIDE)
    x, y, z = ((numbers >= first[:, None]) & (numbers < beyond[:, None])).swapaxes(0, 1)
    return (x[:, :, None, None] & y[:, None, :, None] & z[:, None, None, :]).reshape(-1, CELLS)
