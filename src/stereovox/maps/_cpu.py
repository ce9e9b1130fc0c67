# SPDX-License-Identifier: Apache-2.0
"""Kernels over blocks: rebuild the hash, add evidence, look cells up."""

import numpy as np

from stereovox._jit import kernel
from stereovox.maps._cells import EMPTY, added, empty_slot, find, find_or_insert, home_slot, number_in, row_of, slot_of


@kernel
def rebuild(table, coords, n):
    """Enter the first `n` blocks of the pool into an empty hash table."""
    table[:] = EMPTY
    mask = table.size - 1
    for i in range(n):
        slot = home_slot(coords[i, 0], coords[i, 1], coords[i, 2], mask)
        while table[slot] != EMPTY:
            slot = (slot + 1) & mask
        table[slot] = i


@kernel
def insert_all(table, coords, count, wanted, indices):
    """Find or make every block of `wanted` (n, 3); write pool indices to `indices` (n,)."""
    for i in range(wanted.shape[0]):
        indices[i] = find_or_insert(table, coords, count, wanted[i, 0], wanted[i, 1], wanted[i, 2])


@kernel
def find_all(table, coords, wanted, indices):
    """Write the pool indices of blocks `wanted` (n, 3) to `indices` (n,), -1 where there is none."""
    for i in range(wanted.shape[0]):
        indices[i] = find(table, coords, wanted[i, 0], wanted[i, 1], wanted[i, 2])


@kernel
def remove_all(table, coords, count, cells, flags, fill, gone):
    """Take blocks `gone` (n, 3), each there or not, out of the pool; the last block moves into each gap."""
    for k in range(gone.shape[0]):
        slot = slot_of(table, coords, gone[k, 0], gone[k, 1], gone[k, 2])
        if slot < 0:
            continue
        i = table[slot]
        empty_slot(table, coords, slot)
        last = np.int32(count[0] - 1)
        if i != last:
            table[slot_of(table, coords, coords[last, 0], coords[last, 1], coords[last, 2])] = i
            coords[i] = coords[last]
            cells[i] = cells[last]
            flags[i] = flags[last]
        cells[last] = fill
        flags[last] = 0
        count[0] = last


@kernel
def rescale(values, factor, out):
    """Write `values` (n, 512) times `factor`, rounded to whole numbers, to `out` (n, 512) int16."""
    for i in range(values.shape[0]):
        for c in range(512):
            out[i, c] = np.int16(np.rint(np.float32(values[i, c]) * factor))


@kernel
def add_values(table, coords, count, cells, at_floor, wanted, values, unknown, prior, lowest, highest):
    """Add `values` (n, 512) to blocks `wanted` (n, 3) with clamping; return how many cells changed.

    A block whose values are all zero is not made. `unknown` is what cells without evidence hold: they start from
    `prior`; where a sum comes to just `unknown`, one more is stored.
    """
    changed = 0
    for i in range(wanted.shape[0]):
        value = values[i]
        anything = np.int16(0)
        for c in range(512):
            anything |= value[c]
        if anything == 0:
            continue
        b = find_or_insert(table, coords, count, wanted[i, 0], wanted[i, 1], wanted[i, 2])
        block = cells[b]
        moved = np.int32(0)
        for c in range(512):
            old = np.int32(block[c])
            new = added(old, np.int32(value[c]), unknown, prior, lowest, highest)
            moved = np.int32(moved + (np.int32(1) if new != old else np.int32(0)))
            block[c] = new
        at_floor[b] = 0
        changed += moved
    return changed


@kernel
def add_constant(table, coords, count, cells, at_floor, wanted, step, unknown, prior, lowest):
    """Add the negative number `step` to all cells of blocks `wanted` (n, 3); return how many cells changed.

    A block whose cells all sit at the floor already costs one look.
    """
    changed = 0
    for i in range(wanted.shape[0]):
        b = find_or_insert(table, coords, count, wanted[i, 0], wanted[i, 1], wanted[i, 2])
        if at_floor[b]:
            continue
        block = cells[b]
        moved = np.int32(0)
        above = np.int32(0)
        for c in range(512):
            old = np.int32(block[c])
            new = max(np.int32((prior if old == unknown else old) + step), lowest)
            new = np.int32(new + (np.int32(1) if new == unknown else np.int32(0)))
            moved = np.int32(moved + (np.int32(1) if new != old else np.int32(0)))
            above = np.int32(above + (np.int32(1) if new != lowest else np.int32(0)))
            block[c] = new
        at_floor[b] = 1 if above == 0 else 0
        changed += moved
    return changed


@kernel
def look_up(stored, indices, out):
    """Write the stored number of each cell of `indices` (n, 3) int64 to `out` (n,)."""
    for i in range(indices.shape[0]):
        x, y, z = indices[i, 0], indices[i, 1], indices[i, 2]
        out[i] = number_in(stored, row_of(stored, x >> 3, y >> 3, z >> 3), x, y, z)
