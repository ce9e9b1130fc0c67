# SPDX-License-Identifier: Apache-2.0
"""Kernels over blocks: rebuild the hash, enter blocks."""

from stereovox._jit import kernel
from stereovox.maps._cells import EMPTY, enter, find_or_insert


@kernel
def rebuild(table, coords, n):
    """Enter the first `n` blocks of the pool into an empty hash table."""
    table[:] = EMPTY
    for i in range(n):
        enter(table, coords, i)


@kernel
def insert_all(table, coords, count, wanted, indices):
    """Find or make every block of `wanted` (n, 3); write pool indices to `indices` (n,)."""
    for i in range(wanted.shape[0]):
        indices[i] = find_or_insert(table, coords, count, wanted[i, 0], wanted[i, 1], wanted[i, 2])
