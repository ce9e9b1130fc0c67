# SPDX-License-Identifier: Apache-2.0
"""Kernels over blocks: rebuild the hash, enter blocks."""

from stereovox._jit import kernel
from stereovox.maps._cells import EMPTY, find_or_insert, home_slot


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
