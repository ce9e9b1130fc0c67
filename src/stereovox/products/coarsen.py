# SPDX-License-Identifier: Apache-2.0
"""A map in larger cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.pyramid import coarser_config
from stereovox.maps.voxel_map import cells_where
from stereovox.products.block_pairs import set_times

Parents = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.uint32]]
"""Cells (N, 3); and (N,) the number of known cells in each, the largest value these store, their latest time."""


@one_state
def coarsen(voxel_map: VoxelMap, factor: int) -> VoxelMap:
    """Merge cells into larger ones.

    A coarse cell has the worst state of its parts: occupied, then tentative, unknown, free. So it is free only if
    all of them are, and nothing occupied is lost. Its log-odds are the largest of theirs, its time the latest.

    Args:
        voxel_map: The map.
        factor: How many times longer each side becomes; a whole number, 1 or more.

    Returns:
        An unbounded map with the history of `voxel_map`.

    Raises:
        StereovoxError: `factor` is not such a number, or makes cells too large.
    """
    if not 1 <= factor < 2**31 or factor != int(factor):
        raise StereovoxError(f"factor {factor}: give a whole number of cells, 1 or more")
    settings = coarser_config(voxel_map.config, int(factor))
    parts = [_parents(voxel_map, coords, cells, int(factor)) for coords, cells in voxel_map.storage.slabs()]
    indices, number, stored, times = _grouped(*map(np.concatenate, zip(*parts, strict=True)))
    sure = (number == int(factor) ** 3) | (CellRules(voxel_map.config.map).states(stored) != State.FREE)
    coarse = VoxelMap.from_cells(settings, indices[sure], voxel_map.storage.cell_format.log_odds(stored[sure]))
    if settings.map.keep_times:
        set_times(coarse, indices[sure], times[sure], voxel_map.storage.times_start_ns)
    coarse.storage.take_history(voxel_map.storage)
    return coarse


def _parents(voxel_map: VoxelMap, coords: NDArray[np.int32], cells: NDArray[np.integer], factor: int) -> Parents:
    known = cells != voxel_map.storage.cell_format.unknown
    indices, stored = cells_where(coords, cells, known)
    times = np.zeros(len(stored), np.uint32)
    if voxel_map.config.map.keep_times:
        times = voxel_map.storage.times_of(coords)[known]
    return _grouped(indices.astype(np.int64) // factor, np.ones(len(stored), np.int64), stored.astype(np.int64), times)


def _grouped(
    indices: NDArray[np.int64], number: NDArray[np.int64], stored: NDArray[np.int64], times: NDArray[np.uint32]
) -> Parents:
    """Return each cell once, with the sum of the numbers of cells and the largest of the rest."""
    if not len(indices):
        return indices, number, stored, times
    order = np.lexsort(indices.T)
    indices = indices[order]
    starts = np.flatnonzero(np.append(True, (indices[1:] != indices[:-1]).any(axis=1)))
    highest, latest = (np.maximum.reduceat(values[order], starts) for values in (stored, times))
    return indices[starts], np.add.reduceat(number[order], starts), highest, latest
