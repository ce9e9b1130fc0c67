# SPDX-License-Identifier: Apache-2.0
"""Sets of cells as sorted int64 keys, one per cell, so that membership is a binary search."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.maps import VoxelMap

_BITS = 21
_HALF = 1 << (_BITS - 1)

Keys = NDArray[np.int64]
"""(N,) int64, ascending and unique if it is a set."""


def occupied_cells(voxel_map: VoxelMap) -> NDArray[np.int64]:
    """Return the indices (N, 3) of all occupied cells of a map, ascending."""
    return np.floor(voxel_map.occupied() / voxel_map.voxel_size).astype(np.int64)


def keys(indices: ArrayLike) -> Keys:
    """Return one key (N,) for each cell index (N, 3) in [-2^20, 2^20); ascending keys mean ascending indices."""
    shifted = np.asarray(indices, np.int64).reshape(-1, 3) + _HALF
    return (shifted[:, 0] << 2 * _BITS) | (shifted[:, 1] << _BITS) | shifted[:, 2]


def indices(cell_keys: Keys) -> NDArray[np.int32]:
    """Return the cell indices (N, 3) of keys (N,)."""
    mask = (1 << _BITS) - 1
    columns = [cell_keys >> 2 * _BITS, (cell_keys >> _BITS) & mask, cell_keys & mask]
    return (np.stack(columns, axis=1) - _HALF).astype(np.int32)


def position(cell_keys: Keys, among: Keys) -> NDArray[np.int64]:
    """Return the index of each key (N,) in the ascending set `among`, -1 if it is absent."""
    if not len(among):
        return np.full(len(cell_keys), -1)
    place = np.minimum(np.searchsorted(among, cell_keys), len(among) - 1)
    return np.where(among[place] == cell_keys, place, -1)


def within(cell_keys: Keys, among: Keys, tolerance: int) -> NDArray[np.bool_]:
    """Return which cells have a cell of the set `among` within `tolerance` cells along every axis."""
    found = position(cell_keys, among) >= 0
    reach = range(-tolerance, tolerance + 1)
    for dx, dy, dz in itertools.product(reach, reach, reach):
        missing = np.flatnonzero(~found)
        step = (dx << 2 * _BITS) + (dy << _BITS) + dz
        found[missing] = position(cell_keys[missing] + step, among) >= 0
    return found
