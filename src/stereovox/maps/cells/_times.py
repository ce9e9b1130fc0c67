# SPDX-License-Identifier: Apache-2.0
"""Kernels over the times of cells: renew them by evidence, remove blocks, find cells long without evidence.

Every kernel takes the times as three arrays and a number: `table`, `coords`, `times` (rows, 512) uint32 and `count`
(1,). The caller has made room. Rows that are not in use hold zeros.
"""

import numpy as np

from stereovox.kernels._jit import cell, kernel
from stereovox.maps.cells._cells import find, find_or_insert, home_slot, says_something
from stereovox.maps.cells._pool import forget

NEVER = np.uint32(0)
NIL = np.int16(0)
SLOTS = 64
"""Turns in which each block is inspected once; a block's turn is a hash of its coordinates."""


@kernel
def missing(table, coords, wanted, values, uniform):
    """Return how many blocks of evidence have no times yet: `wanted` (n, 3) with any `values`, `uniform` (m, 3)."""
    number = 0
    for i in range(wanted.shape[0]):
        number += says_something(values[i]) and find(table, coords, wanted[i, 0], wanted[i, 1], wanted[i, 2]) < 0
    for i in range(uniform.shape[0]):
        number += find(table, coords, uniform[i, 0], uniform[i, 1], uniform[i, 2]) < 0
    return number


@kernel
def write(table, coords, times, count, wanted, values, uniform, now):
    """Set the cells that get evidence to `now`: those of `values` (n, 512) that are not zero, all of `uniform`."""
    for i in range(wanted.shape[0]):
        if says_something(values[i]):
            row = find_or_insert(table, coords, count, wanted[i, 0], wanted[i, 1], wanted[i, 2])
            given, mine = values[i], times[row]
            for c in range(512):
                mine[c] = now if given[c] != NIL else mine[c]
    for i in range(uniform.shape[0]):
        row = find_or_insert(table, coords, count, uniform[i, 0], uniform[i, 1], uniform[i, 2])
        mine = times[row]
        for c in range(512):
            mine[c] = now


@kernel
def remove(table, coords, times, count, gone):
    """Remove the times of blocks `gone` (n, 3), whether present or not."""
    for i in range(gone.shape[0]):
        _remove(table, coords, times, count, gone[i, 0], gone[i, 1], gone[i, 2])


@kernel
def follow(table, coords, times, count, cells_table, cells_coords, low, high):
    """Remove the times of blocks within cells [low, high), (3,) int32 each, of which the map has no cells."""
    for bx in range(low[0] >> 3, ((high[0] - 1) >> 3) + 1):
        for by in range(low[1] >> 3, ((high[1] - 1) >> 3) + 1):
            for bz in range(low[2] >> 3, ((high[2] - 1) >> 3) + 1):
                if find(cells_table, cells_coords, bx, by, bz) < 0:
                    _remove(table, coords, times, count, bx, by, bz)


@kernel
def due(coords, times, count, first, turns, now, most, out):
    """Write the places of blocks with a time more than `most` away from `now` to `out`; return their number.

    Only the blocks of the `turns` turns from `first` on are inspected.
    """
    number = 0
    for row in range(count[0]):
        turn = home_slot(coords[row, 0], coords[row, 1], coords[row, 2], SLOTS - 1)
        if (turn - first) & (SLOTS - 1) < turns and _any_past(times[row], now, most):
            out[number] = row
            number += 1
    return number


@cell
def _remove(table, coords, times, count, x, y, z):
    before = count[0]
    forget(table, coords, times, count, x, y, z)
    if count[0] < before:
        freed = times[count[0]]
        for c in range(512):
            freed[c] = NEVER


@cell
def _any_past(times, now, most):
    """Return whether a time is too far from `now`, before or after it; all uint32."""
    past = np.uint32(0)
    for c in range(512):
        away = np.uint32(max(times[c], now) - min(times[c], now))
        past |= np.uint32((times[c] != NEVER) & (away > most))
    return past != 0
