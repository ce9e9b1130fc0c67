# SPDX-License-Identifier: Apache-2.0
"""A sparse set of blocks of 8x8x8 cells: a pool of values and a hash from block coordinates to the pool.

Integrators collect evidence in it, and grids keep their tiles in it: blocks of other sizes at height 0. Voxel maps have
their own pool (`CellPool`).
"""

from __future__ import annotations

from math import prod
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stereovox.maps.cells import _pool

SIDE = 8
"""Cells along each side of a block."""
CELLS = SIDE**3
MAX_PLACES = 2**62
"""Most places in a box that one int64 can count."""


def blocks_of_cells(cells: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the blocks (n, 3) that contain cells (N, 3), each once in ascending order, and the block index of each
    cell (N,).

    Each block gets one number, which sorts much faster than rows of three.
    """
    coords = np.asarray(cells, np.int64) >> 3
    if not len(coords):
        return coords, np.zeros(0, np.int64)
    low = coords.min(axis=0)
    _, y_side, z_side = sides = [int(n) + 1 for n in coords.max(axis=0) - low]
    if prod(sides) > MAX_PLACES:
        blocks, of_cell = np.unique(coords, axis=0, return_inverse=True)
        return blocks, of_cell.ravel()
    x, y, z = (coords - low).T
    places, of_cell = np.unique((x * y_side + y) * z_side + z, return_inverse=True)
    blocks = np.stack([places // (y_side * z_side), places // z_side % y_side, places % z_side], axis=1)
    return blocks + low, of_cell


def span_of(coords: NDArray[np.int32], known: NDArray[np.bool_]) -> tuple[list[int], list[int]] | None:
    """Return the lowest `known` cell (n, 512) of blocks (n, 3) on each axis, and the first beyond the highest."""
    if not known.any():
        return None
    known = known.reshape(-1, SIDE, SIDE, SIDE)
    ends = []
    for axis in range(3):
        layers = (coords[:, axis, None] * SIDE + np.arange(SIDE))[known.any(axis=tuple({1, 2, 3} - {axis + 1}))]
        ends.append((int(layers.min()), int(layers.max()) + 1))
    lowest, beyond = zip(*ends, strict=True)
    return list(lowest), list(beyond)


class StoredCells(NamedTuple):
    """All cells of a map as kernels read them, with `row_of` and `number_in` of `_cells.py`; read-only."""

    table: NDArray[np.int32]
    coords: NDArray[np.int32]  # (rows + bare, 3): of blocks with a row, then of those without, all at `lowest`
    values: NDArray[np.integer]  # (rows, 512)
    unknown: np.int32  # the value of a cell without evidence
    lowest: np.int32  # the lowest value of a cell


class BlockPool:
    """Blocks in the order of creation. Cell (i, j, k) of a block is at `64 i + 8 j + k` of its row.

    coords: (capacity, 3) int32 block coordinates; block (0, 0, 0) holds cells 0..7 on each axis.
    values: (capacity, `cells`) of the chosen dtype, `fill` where never written.
    count: (1,) int64, the number of blocks in use.
    """

    def __init__(self, dtype: DTypeLike, capacity: int = 256, fill: int = 0, cells: int = CELLS):
        self.fill = fill
        self.count = np.zeros(1, np.int64)
        self.coords = np.zeros((capacity, 3), np.int32)
        self.values = _filled((capacity, cells), fill, dtype)
        self.table = np.empty(table_size(capacity), np.int32)
        _pool.rebuild_all(self.table, self.coords, 0)

    def __len__(self) -> int:
        return int(self.count[0])

    @property
    def memory_bytes(self) -> int:
        """Bytes of all arrays in use: filled blocks and the hash."""
        return len(self) * (self.values[0].nbytes + self.coords.itemsize * 3) + self.table.nbytes

    def reserve(self, more: int) -> None:
        """Make room for `more` further blocks; existing blocks keep their place."""
        needed = len(self) + more
        if needed <= self.coords.shape[0]:
            return
        capacity = max(needed, 2 * self.coords.shape[0])
        self.coords = _grown(self.coords, capacity, len(self), 0)
        self.values = _grown(self.values, capacity, len(self), self.fill)
        self.table = np.empty(table_size(capacity), np.int32)
        _pool.rebuild_all(self.table, self.coords, len(self))

    def insert(self, coords: NDArray[np.int32]) -> NDArray[np.int64]:
        """Find or create blocks (n, 3); return their places in the pool (n,)."""
        self.reserve(len(coords))
        places = np.empty(len(coords), np.int64)
        _pool.insert_all(self.table, self.coords, self.count, np.ascontiguousarray(coords, np.int32), places)
        return places

    def clear(self) -> None:
        """Remove all blocks and their content; the memory is kept for the next use."""
        self.values[: len(self)] = self.fill
        self.table.fill(-1)
        self.count[0] = 0


def table_size(capacity: int) -> int:
    """Return the slots of a hash table for `capacity` blocks, a power of two: less than half is in use."""
    return 1 << int(2 * capacity - 1).bit_length()


def _grown(array: NDArray, capacity: int, used: int, fill: int) -> NDArray:
    grown = _filled((capacity, *array.shape[1:]), fill, array.dtype)
    grown[:used] = array[:used]
    return grown


def _filled(shape: tuple[int, ...], fill: int, dtype: DTypeLike) -> NDArray:
    """Return an array of `fill`; the system provides memory of zeros only on first use."""
    return np.full(shape, fill, dtype) if fill else np.zeros(shape, dtype)
