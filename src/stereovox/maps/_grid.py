# SPDX-License-Identifier: Apache-2.0
"""Kernels over tiles of 64x64 cells: add evidence, look cells up, draw them as one picture."""

import numpy as np

from stereovox.kernels._jit import cell, kernel
from stereovox.maps.cells._cells import added, find, find_or_insert


@kernel
def add_tiles(table, coords, count, cells, wanted, values, unknown, prior, lowest, highest):
    """Add `values` (n, 4096) to tiles `wanted` (n, 3) with clamping; return how many cells changed.

    Like `_add.add` for blocks: a tile whose values are all zero is not created, cells without evidence start from
    `prior`, and a sum of exactly `unknown` is stored as one more.
    """
    changed = 0
    for i in range(wanted.shape[0]):
        value = values[i]
        anything = np.int32(0)
        for c in range(4096):
            anything |= np.int32(value[c])
        if anything == 0:
            continue
        tile = cells[find_or_insert(table, coords, count, wanted[i, 0], wanted[i, 1], wanted[i, 2])]
        for row in range(0, 4096, 64):
            changed += _add_row(tile[row : row + 64], value[row : row + 64], unknown, prior, lowest, highest)
    return changed


@cell
def _add_row(cells, value, unknown, prior, lowest, highest):
    """Add `value` (64,) to cells of a row; return how many changed."""
    anything = np.int32(0)
    for c in range(64):
        anything |= np.int32(value[c])
    moved = np.int32(0)
    if anything != 0:
        for c in range(64):
            old = np.int32(cells[c])
            new = added(old, np.int32(value[c]), unknown, prior, lowest, highest)
            moved = np.int32(moved + (np.int32(1) if new != old else np.int32(0)))
            cells[c] = new
    return moved


@kernel
def look_up(table, coords, cells, indices, out):
    """Write the number of each cell (column, row) of `indices` (n, 2) int64 to `out` (n,), unchanged without a tile."""
    for i in range(indices.shape[0]):
        x, y = indices[i, 0], indices[i, 1]
        tile = find(table, coords, x >> 6, y >> 6, 0)
        if tile >= 0:
            out[i] = cells[tile, ((y & 63) << 6) | (x & 63)]


@kernel
def show(coords, cells, first_column, first_row, shown, lowest, picture):
    """Write all tiles `cells` (n, 4096) to `picture`, converted by the table `shown`, which starts at `lowest`."""
    rows, columns = picture.shape
    for i in range(coords.shape[0]):
        left, bottom = (coords[i, 0] << 6) - first_column, (coords[i, 1] << 6) - first_row
        column, until = max(left, 0), min(left + 64, columns)
        for row in range(max(bottom, 0), min(bottom + 64, rows)):
            start = ((row - bottom) << 6) + column - left
            stored, out = cells[i, start : start + until - column], picture[row, column:until]
            for k in range(out.size):
                out[k] = shown[np.uint32(np.int32(stored[k]) - lowest)]  # unsigned: no test for negative indices
