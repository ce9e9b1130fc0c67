# SPDX-License-Identifier: Apache-2.0
"""Kernels over blocks: rebuild the hash, add evidence, look cells up."""

import numpy as np

from stereovox._jit import kernel
from stereovox.maps._cells import EMPTY, find, find_or_insert, home_slot


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
def add_values(table, coords, count, cells, at_floor, wanted, values, lowest, highest):
    """Add `values` (n, 512) to blocks `wanted` (n, 3) with clamping; return how many cells changed.

    A block whose values are all zero is not made. A sum of zero is stored as 1: zero is kept for "unknown".
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
            step = np.int32(value[c])
            new = min(max(old + step, lowest), highest)
            new += np.int32(1) if (new == 0) & (step != 0) else np.int32(0)
            moved += np.int32(1) if new != old else np.int32(0)
            block[c] = np.int16(new)
        at_floor[b] = 0
        changed += moved
    return changed


@kernel
def add_constant(table, coords, count, cells, at_floor, wanted, step, lowest):
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
            new = max(old + step, lowest)
            new += np.int32(1) if new == 0 else np.int32(0)
            moved += np.int32(1) if new != old else np.int32(0)
            above += np.int32(1) if new != lowest else np.int32(0)
            block[c] = np.int16(new)
        at_floor[b] = 1 if above == 0 else 0
        changed += moved
    return changed


@kernel
def look_up(table, coords, cells, indices, out):
    """Write the value of each cell of `indices` (n, 3) int64 to `out` (n,); 0 where there is no block."""
    for i in range(indices.shape[0]):
        x, y, z = indices[i, 0], indices[i, 1], indices[i, 2]
        b = find(table, coords, x >> 3, y >> 3, z >> 3)
        out[i] = cells[b, ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)] if b >= 0 else np.int16(0)
