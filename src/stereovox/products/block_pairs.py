# SPDX-License-Identifier: Apache-2.0
"""Access to maps block by block, singly and in pairs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap, unbounded
from stereovox.maps.storage.blocks import CELLS, SIDE, blocks_of_cells
from stereovox.maps.storage.rolling import RollingStorage

Blocks = tuple[NDArray[np.int32], NDArray[np.integer], NDArray[np.integer]]
"""Coordinates (n, 3), and the cells (n, 512) of two maps as each stores them."""


def in_memory(voxel_map: VoxelMap) -> VoxelMap:
    """Return the map with all its cells in memory: the map itself if they already are."""
    return unbounded(voxel_map) if isinstance(voxel_map.storage, RollingStorage) else voxel_map


def cells_at(voxel_map: VoxelMap, coords: NDArray[np.int32]) -> NDArray[np.integer]:
    """Return the cells (n, 512) as stored of blocks (n, 3) of a map in memory; all unknown if it has no block."""
    return voxel_map.storage.cells_of(coords)


def block_pairs(a: VoxelMap, b: VoxelMap) -> Iterator[Blocks]:
    """Yield every block of either of two maps in memory, with the cells of both, piece by piece."""
    for coords, cells in a.storage.slabs():
        yield coords, cells, cells_at(b, coords)
    for coords, cells in b.storage.slabs():
        theirs = cells_at(a, coords)
        new = (theirs == a.storage.cell_format.unknown).all(axis=1)
        yield coords[new], theirs[new], cells[new]


def check_alike(a: VoxelMap, b: VoxelMap, T_a_b: ArrayLike | None) -> None:
    """Raise StereovoxError if two maps differ in cell size, or, without a transform, in their `up`."""
    if T_a_b is None and a.config.up != b.config.up:
        raise StereovoxError(
            f"up is {a.config.up} in one map and {b.config.up} in the other; give the transform between them"
        )
    if T_a_b is None and a.config.levelled_from != b.config.levelled_from:
        raise StereovoxError(
            "the maps were levelled differently, so their worlds differ; give the transform between them"
        )
    if not np.allclose(a.config.cell, b.config.cell, rtol=1e-9, atol=0):
        sizes = " and ".join(" x ".join(f"{side:g}" for side in _short(one)) for one in (a, b))
        raise StereovoxError(
            f"the maps have cells of {sizes} m; bring the finer one to the size of the other with: stereovox coarsen"
        )


def add_blocks(target: VoxelMap, source: VoxelMap, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
    """Add blocks (n, 3) with cells (n, 512) to `target`, with the times that `source` keeps of them."""
    known = (cells != target.storage.cell_format.unknown).any(axis=1)
    target.storage.insert(coords[known], cells[known])
    if source.config.map.keep_times:
        target.storage.set_times(coords[known], source.storage.times_of(coords[known]), source.storage.times_start_ns)


def set_times(target: VoxelMap, indices: NDArray[np.integer], times: NDArray[np.uint32], start_ns: int | None) -> None:
    """Set the times (N,), counted from `start_ns`, of distinct cells (N, 3) of a map."""
    blocks, of_cell = blocks_of_cells(indices)
    low = indices & (SIDE - 1)
    kept = np.zeros((len(blocks), CELLS), np.uint32)
    kept[of_cell, (low[:, 0] << 6) | (low[:, 1] << 3) | low[:, 2]] = times
    target.storage.set_times(blocks.astype(np.int32), kept, start_ns)


def _short(voxel_map: VoxelMap) -> tuple[float, ...]:
    cell = voxel_map.config.cell
    return cell if len(set(cell)) > 1 else cell[:1]
