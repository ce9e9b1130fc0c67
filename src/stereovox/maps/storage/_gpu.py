# SPDX-License-Identifier: Apache-2.0
"""Kernels that keep the blocks of a map on a graphics card: the loops of `_add.py` and `_pool.py` over the same cells.

The hash table is the one of `_cells.py`. Entries are inserted by compare-and-swap, in a separate kernel: no lookup runs
during insertion, so a visible entry always has its coordinates.
"""

import math

import numpy as np

from stereovox.kernels._gpu import cuda, gpu_kernel, on_gpu
from stereovox.maps.cells import _add, _cells
from stereovox.maps.cells._add import MAKE, SKIP
from stereovox.maps.cells._cells import EMPTY

USED, MISSING, CHANGED = 0, 1, 2
"""Places in `counts` (COUNTS,) int32: rows in use; rows that evidence needs; cells that evidence changed."""
COUNTS = 3

find, home_slot = on_gpu(_cells.find), on_gpu(_cells.home_slot)
added_step, rescaled = on_gpu(_add.added_step), on_gpu(_add.rescaled)
chosen, weighed, looked_through = on_gpu(_add.chosen), on_gpu(_add.weighed), on_gpu(_add.looked_through)


@gpu_kernel
def find_places(table, coords, wanted, said, n, places, counts):
    """Write the row of each of the first `n` blocks of `wanted`, or SKIP, or MAKE, to `places`; count the last.

    said: (n,) int16, 0 for blocks about which there is no evidence.
    """
    for i in range(cuda.grid(1), n, cuda.gridsize(1)):
        place = find(table, coords, wanted[i, 0], wanted[i, 1], wanted[i, 2])
        if said[i] == 0:
            place = SKIP
        elif place < 0:
            place = MAKE
            cuda.atomic.add(counts, MISSING, 1)
        places[i] = place


@gpu_kernel
def make_rows(table, coords, counts, wanted, n, places):
    """Make a row for each of the first `n` blocks of `wanted` marked MAKE, and write its index; there must be room."""
    for i in range(cuda.grid(1), n, cuda.gridsize(1)):
        if places[i] == MAKE:
            row = cuda.atomic.add(counts, USED, 1)
            for axis in range(3):
                coords[row, axis] = wanted[i, axis]
            slot = home_slot(wanted[i, 0], wanted[i, 1], wanted[i, 2], table.size - 1)
            while cuda.atomic.cas(table, slot, EMPTY, row) != EMPTY:
                slot = (slot + 1) & (table.size - 1)
            places[i] = row


@gpu_kernel
def enter_all(table, coords, n):
    """Insert the first `n` blocks of the pool, all different, into an empty hash table."""
    for place in range(cuda.grid(1), n, cuda.gridsize(1)):
        slot = home_slot(coords[place, 0], coords[place, 1], coords[place, 2], table.size - 1)
        while cuda.atomic.cas(table, slot, EMPTY, np.int32(place)) != EMPTY:
            slot = (slot + 1) & (table.size - 1)


@gpu_kernel
def copy(source, target, n):
    """Copy the first `n` numbers of a flat array."""
    for i in range(cuda.grid(1), n, cuda.gridsize(1)):
        target[i] = source[i]


@gpu_kernel
def add(values, places, steps, n, limits, counts):
    """Add `steps` (n, 512) int16 to the rows at `places`, and count the cells that changed.

    limits: unknown, prior, lowest and highest stored number, int16.
    """
    unknown, prior, lowest, highest = limits
    for i in range(cuda.blockIdx.x, n, cuda.gridDim.x):
        row = places[i]
        if row >= 0:
            moved = 0
            for c in range(cuda.threadIdx.x, 512, cuda.blockDim.x):
                old = np.int16(values[row, c])
                new = added_step(old, steps[i, c], unknown, prior, lowest, highest)
                values[row, c] = new
                moved += new != old
            if moved > 0:
                cuda.atomic.add(counts, CHANGED, moved)


@gpu_kernel
def add_uniform(values, places, steps, n, limits, counts):
    """Add one of `steps` (n,) int16 to all cells of each row at `places`, as `add` does."""
    unknown, prior, lowest, highest = limits
    for i in range(cuda.blockIdx.x, n, cuda.gridDim.x):
        row = places[i]
        if row >= 0:
            moved = 0
            for c in range(cuda.threadIdx.x, 512, cuda.blockDim.x):
                old = np.int16(values[row, c])
                new = added_step(old, steps[i], unknown, prior, lowest, highest)
                values[row, c] = new
                moved += new != old
            if moved > 0:
                cuda.atomic.add(counts, CHANGED, moved)


@gpu_kernel
def rescale(values, n, factor, shift, most, out):
    """Apply `_add.rescale` to the first `n` rows of `values`."""
    for i in range(cuda.grid(1), 512 * n, cuda.gridsize(1)):
        out[i >> 9, i & 511] = rescaled(values[i >> 9, i & 511], factor, shift, most)


@gpu_kernel
def rescale_steps(steps, n, factor, shift, out):
    """Write `steps` (n,) int16 times `factor`, plus `shift`, both float64, rounded down to whole numbers, to `out`."""
    for i in range(cuda.grid(1), n, cuda.gridsize(1)):
        out[i] = np.int16(math.floor(np.float64(steps[i]) * factor + shift))


@gpu_kernel
def weigh(stored, sure, least, coords, values, n, mask, sums):
    """Add the weights of the first `n` blocks of evidence to `sums` (5,) int64, as `_add.weigh` does."""
    for i in range(cuda.grid(1), n, cuda.gridsize(1)):
        if chosen(coords, i, mask):
            hits, passes, into, edge, every = weighed(stored, sure, least, coords, i, values[i])
            cuda.atomic.add(sums, 0, hits)
            cuda.atomic.add(sums, 1, passes)
            cuda.atomic.add(sums, 2, into)
            cuda.atomic.add(sums, 3, edge)
            cuda.atomic.add(sums, 4, every)


@gpu_kernel
def weigh_uniform(stored, sure, coords, steps, n, mask, sums):
    """Add the weights of the first `n` uniform blocks to `sums` (5,) int64, as `_add.weigh` does."""
    for i in range(cuda.grid(1), n, cuda.gridsize(1)):
        if chosen(coords, i, mask):
            cuda.atomic.add(sums, 1, looked_through(stored, sure, coords, i, steps[i]))
