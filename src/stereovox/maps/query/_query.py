# SPDX-License-Identifier: Apache-2.0
"""Shared by all queries: cells at points, states, a cache of rows, and marks on relevant cells."""

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell, exact_cell
from stereovox.maps.cells import _cells
from stereovox.maps.cells._cells import EMPTY, NO_ROW, number_in, row_of

LATELY = (4096, 4)
NOWHERE = np.int32(2**30)
"""No block has this coordinate."""
UNKNOWN, TENTATIVE = np.int32(_cells.UNKNOWN), np.int32(_cells.TENTATIVE)
UNKNOWN_BIT = np.uint8(1 << _cells.UNKNOWN)
BIT, ONE, NO_BITS = np.uint8(1), np.int32(1), np.uint64(0)


@allocating_kernel
def look_up(stored, side, limit, points, out):
    """Write the stored number of the cell at each of `points` (n, 3) to `out` (n,).

    side: (3,) sides of a cell. Beyond +-`limit` cells all is unknown, and so is NaN.
    """
    far = np.float64(limit)
    lately = np.full(LATELY, NOWHERE, np.int32)
    for i in range(points.shape[0]):
        x = np.floor(cells_from_zero(points[i, 0], side[0]))
        y = np.floor(cells_from_zero(points[i, 1], side[1]))
        z = np.floor(cells_from_zero(points[i, 2], side[2]))
        if not (abs(x) < far and abs(y) < far and abs(z) < far):
            out[i] = stored.unknown
            continue
        ix, iy, iz = np.int64(x), np.int64(y), np.int64(z)
        out[i] = number_in(stored, row_again(stored, lately, ix >> 3, iy >> 3, iz >> 3), ix, iy, iz)


@exact_cell
def cells_from_zero(place, side):
    """Return a place in cells, rounded as in NumPy at faces."""
    return np.float64(place) / side


@cell
def row_again(stored, lately, bx, by, bz):
    """Do as `row_of`, from a cache if possible; 16 x 16 x 16 neighbouring blocks do not evict each other.

    lately: (4096, 4) int32 block coordinates and row, NOWHERE at first.
    """
    entry = ((bx & 15) << 8) | ((by & 15) << 4) | (bz & 15)
    if lately[entry, 0] != bx or lately[entry, 1] != by or lately[entry, 2] != bz:
        lately[entry, 0], lately[entry, 1], lately[entry, 2] = bx, by, bz
        lately[entry, 3] = row_of(stored, bx, by, bz)
    return np.int64(lately[entry, 3])


@cell
def state_of(stored, rules, number):
    """Return the `State` of a stored number, int32; rules: `Thresholds`."""
    above = ONE if number >= rules.occupied_least else np.int32(0)
    below = ONE if number <= rules.free_most else np.int32(0)
    return UNKNOWN if number == stored.unknown else np.int32(TENTATIVE + above - below)


@cell
def level_of(stored, rules, wanted, row, marks, levels):
    """Return the highest level among the cells of a block, -1 if none is wanted; `row` comes from `row_of`.

    Cells of a row are marked on first use; without a row all cells of a block have one level.
    wanted: (n,) uint8, for each level a bit set of its states.
    marks: (rows, n, 8) uint64, one word for each layer of x: bit 8 y + z. levels: (rows,) int8, 0 if not yet used.
    """
    if row < 0:
        return _level(wanted, UNKNOWN if row == NO_ROW else state_of(stored, rules, stored.lowest))
    if levels[row] == 0:
        levels[row] = _mark(stored, rules, wanted, row, marks) + np.int32(2)
    return np.int32(levels[row] - np.int32(2))


@cell
def _mark(stored, rules, wanted, row, marks):
    """Set the marks of a row; return its highest level, -1 if nothing is wanted."""
    highest = np.int32(-1)
    for level in range(wanted.size):
        found = NO_BITS
        for x in range(8):
            word = NO_BITS
            for bit in range(64):
                state = state_of(stored, rules, np.int32(stored.values[row, 64 * x + bit]))
                word |= np.uint64((wanted[level] >> np.uint8(state)) & BIT) << np.uint64(bit)
            marks[row, level, x] = word
            found |= word
        highest = np.int32(level) if found != NO_BITS else highest
    return highest


@cell
def _level(wanted, state):
    """Return the level of a state, -1 if it is not wanted."""
    highest = np.int32(-1)
    for level in range(wanted.size):
        highest = np.int32(level) if (wanted[level] >> np.uint8(state)) & BIT else highest
    return highest


@cell
def extent(stored, low, high):
    """Write the lowest and highest coordinates (3,) of all blocks with a row; low > high if there is none."""
    low[:] = NOWHERE
    high[:] = -NOWHERE
    for i in stored.table:
        if i != EMPTY:
            for axis in range(3):
                low[axis] = min(low[axis], stored.coords[i, axis])
                high[axis] = max(high[axis], stored.coords[i, axis])
