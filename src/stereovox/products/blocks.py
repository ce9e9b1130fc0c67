# SPDX-License-Identifier: Apache-2.0
"""Access to maps block by block, singly and in pairs.

Neighbouring cells: blocks with a margin, and connected components.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap, unbounded
from stereovox.maps.storage.blocks import CELLS, MAX_PLACES, SIDE, blocks_of_cells
from stereovox.maps.storage.rolling import RollingStorage
from stereovox.products import _distance

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


FACES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
CORNERS = tuple((x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) > (0, 0, 0))
"""Steps to half of the cells that share a face with a cell, and to half of those that share a corner with it."""


def with_margins(voxel_map: VoxelMap) -> Iterator[tuple[NDArray[np.int32], NDArray[np.integer]]]:
    """Yield all blocks (n, 3) of a map with a margin of one cell: (n, 10, 10, 10) as stored."""
    for coords, _ in voxel_map.storage.slabs():
        ends = (coords.min(axis=0), coords.max(axis=0) + 1) if len(coords) else (np.zeros(3, int),) * 2
        stored = voxel_map.storage.cells_within(SIDE * ends[0] - 1, SIDE * ends[1] + 1)
        out = np.empty((len(coords), *(SIDE + 2,) * 3), stored.values.dtype)
        _distance.with_margin(stored, np.ascontiguousarray(coords), out)
        yield coords, out


def shifted(margins: NDArray, step: tuple[int, int, int]) -> NDArray:
    """Return, for each cell (n, 8, 8, 8) of blocks with margins, the cell one `step` (at most one cell) away."""
    x, y, z = (slice(1 + d, 1 + d + SIDE) for d in step)
    return margins[:, x, y, z]


def components(cells: NDArray[np.integer], steps: Iterable[tuple[int, int, int]]) -> NDArray[np.int32]:
    """Return the component (N,), from 0, of each of the distinct cells (N, 3).

    Cells that are one of the `steps` apart, in either direction, belong to one component.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(cells):
        return np.zeros(0, np.int32)
    steps = list(steps)
    number, extent = _places(cells, int(np.abs(steps).max()))
    order = np.argsort(number)
    ascending = number[order]
    pairs = [_apart(ascending, int(np.dot(step, (extent[1] * extent[2], extent[2], 1)))) for step in steps]
    one, other = (order[np.concatenate(ends)] for ends in zip(*pairs, strict=True))
    graph = coo_array((np.ones(len(one), bool), (one, other)), shape=(len(cells),) * 2)
    return connected_components(graph, directed=False)[1]


def _places(cells: NDArray[np.integer], longest: int) -> tuple[NDArray[np.int64], list[int]]:
    """Return one number (N,) for each cell, and the sides of the box in which they count.

    The box is padded so that no step, at most `longest` on each axis, wraps around.
    """
    low = cells.min(axis=0).astype(np.int64)
    extent = [int(n) + 1 + longest for n in cells.max(axis=0) - low]
    if extent[0] * extent[1] * extent[2] > MAX_PLACES:
        raise StereovoxError("the map is too wide for a search of connected cells; take a part of it: stereovox crop")
    x, y, z = (cells - low).T
    return (x * extent[1] + y) * extent[2] + z, extent


def _apart(ascending: NDArray[np.int64], step: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the positions of all pairs of ascending numbers that are `step` apart."""
    at = np.searchsorted(ascending, ascending + step).clip(max=len(ascending) - 1)
    found = np.flatnonzero(ascending[at] == ascending + step)
    return found, at[found]
