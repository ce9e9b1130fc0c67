# SPDX-License-Identifier: Apache-2.0
"""Kernel cells: the row of a block in its pool, and the update of one cell by evidence."""

import numpy as np

from stereovox.kernels._jit import cell

UNKNOWN, FREE, TENTATIVE, OCCUPIED = 0, 1, 2, 3
"""States of a cell; see `State`."""
EMPTY, NIL = np.int32(-1), np.int16(0)
NO_ROW, AT_FLOOR = np.int64(-1), np.int64(-2)
"""Instead of a row of values: the block does not exist; all its cells have the lowest value."""


@cell
def added(old, step, unknown, prior, lowest, highest):
    """Return the value of a cell after evidence `step`, clamped; all int32.

    A cell without evidence, `unknown`, starts from `prior`; a sum of exactly `unknown` is stored as one more.
    """
    start = prior if old == unknown else old
    new = min(max(np.int32(start + step), lowest), highest)
    new = np.int32(new + (np.int32(1) if new == unknown else np.int32(0)))
    return new if step != 0 else old


@cell
def says_something(steps):
    """Return whether evidence (512,) int16 on a block is anything but zeros."""
    anything = NIL
    for c in range(512):
        anything = np.int16(anything | steps[c])
    return anything != NIL


@cell
def copy_row(target, source):
    """Copy `source` (n,) to `target` (n,). Numba's `target[:] = source` would allocate, which no kernel may."""
    for c in range(target.size):
        target[c] = source[c]


@cell
def home_slot(bx, by, bz, mask):
    """Return the slot of the hash table where the search for block (bx, by, bz) starts."""
    h = np.uint64(np.uint32(bx)) * np.uint64(0x9E3779B97F4A7C15)
    h ^= np.uint64(np.uint32(by)) * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= np.uint64(np.uint32(bz)) * np.uint64(0x165667B19E3779F9)
    h ^= h >> np.uint64(32)
    h *= np.uint64(0xD6E8FEB86659FD93)
    return np.int64((h >> np.uint64(32)) & np.uint64(mask))


@cell
def find(table, coords, bx, by, bz):
    """Return the pool index of block (bx, by, bz), -1 if there is none."""
    slot = slot_of(table, coords, bx, by, bz)
    return np.int64(table[slot]) if slot >= 0 else np.int64(-1)


@cell
def row_of(stored, bx, by, bz):
    """Return the row with the cells of block (bx, by, bz), or NO_ROW, or AT_FLOOR; see `StoredCells`."""
    place = find(stored.table, stored.coords, bx, by, bz)
    return AT_FLOOR if place >= stored.values.shape[0] else place


@cell
def number_in(stored, row, x, y, z):
    """Return the stored number of cell (x, y, z), whose block has the row that `row_of` gave."""
    if row < 0:
        return stored.unknown if row == NO_ROW else stored.lowest
    return np.int32(stored.values[row, ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)])


@cell
def slot_of(table, coords, bx, by, bz):
    """Return the slot of the hash table that holds block (bx, by, bz), -1 if there is none."""
    mask = table.size - 1
    slot = home_slot(bx, by, bz, mask)
    while True:
        i = table[slot]
        if i == EMPTY:
            return np.int64(-1)
        if coords[i, 0] == bx and coords[i, 1] == by and coords[i, 2] == bz:
            return slot
        slot = (slot + 1) & mask


@cell
def enter(table, coords, place):
    """Insert the block at `place`, which the table does not contain."""
    mask = table.size - 1
    slot = home_slot(coords[place, 0], coords[place, 1], coords[place, 2], mask)
    while table[slot] != EMPTY:
        slot = (slot + 1) & mask
    table[slot] = place


@cell
def empty_slot(table, coords, slot):
    """Empty a slot of the hash table and close the gap: later entries move up if their search passes it."""
    mask = table.size - 1
    gap, slot = slot, (slot + 1) & mask
    while table[slot] != EMPTY:
        i = table[slot]
        home = home_slot(coords[i, 0], coords[i, 1], coords[i, 2], mask)
        if (slot - home) & mask >= (slot - gap) & mask:
            table[gap] = i
            gap = slot
        slot = (slot + 1) & mask
    table[gap] = EMPTY


@cell
def find_or_insert(table, coords, count, bx, by, bz):
    """Return the pool index of block (bx, by, bz), creating it if needed; -1 if the pool is full.

    `count` is a (1,) int64 array: the number of blocks in the pool.
    """
    mask = table.size - 1
    slot = home_slot(bx, by, bz, mask)
    while True:
        i = table[slot]
        if i == EMPTY:
            break
        if coords[i, 0] == bx and coords[i, 1] == by and coords[i, 2] == bz:
            return np.int64(i)
        slot = (slot + 1) & mask
    n = count[0]
    if n >= coords.shape[0]:
        return np.int64(-1)
    coords[n, 0] = bx
    coords[n, 1] = by
    coords[n, 2] = bz
    table[slot] = n
    count[0] = n + 1
    return np.int64(n)
