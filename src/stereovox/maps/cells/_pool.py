# SPDX-License-Identifier: Apache-2.0
"""Kernels over the blocks of a map: add and remove blocks, and their rows of numbers; see `CellPool`.

Every kernel takes the pool as four arrays: `table`, `coords`, `values`, `count`. A place below `len(values)` is a row,
a place from there on a bare block. The caller has made room.

Kernels over the times of cells: renew them by evidence, remove blocks, find cells long without evidence.

Every kernel takes the times as three arrays and a number: `table`, `coords`, `times` (rows, 512) uint32 and `count`
(1,). The caller has made room. Rows that are not in use hold zeros.
"""

from __future__ import annotations

import numpy as np

from stereovox.kernels._jit import cell, kernel
from stereovox.maps.cells._cells import (
    EMPTY,
    copy_row,
    empty_slot,
    enter,
    find,
    find_or_insert,
    home_slot,
    says_something,
    slot_of,
)


@kernel
def rebuild_all(table, coords, n):
    """Insert the first `n` blocks of the pool into an empty hash table."""
    table[:] = EMPTY
    for i in range(n):
        enter(table, coords, i)


@kernel
def insert_all(table, coords, count, wanted, indices):
    """Find or create every block of `wanted` (n, 3); write pool indices to `indices` (n,)."""
    for i in range(wanted.shape[0]):
        indices[i] = find_or_insert(table, coords, count, wanted[i, 0], wanted[i, 1], wanted[i, 2])


NOTHING, BARE, ROW = np.uint8(0), np.uint8(1), np.uint8(2)
"""What a block of cells needs: nothing (no cell is known), a bare place (all at the floor value), or a row."""


@kernel
def rebuild(table, coords, values, count):
    """Rebuild the hash table from all blocks of the pool."""
    table[:] = EMPTY
    for row in range(count[0]):
        enter(table, coords, row)
    for n in range(count[1]):
        enter(table, coords, values.shape[0] + n)


@kernel
def needs(cells, unknown, lowest, out):
    """Write to `out` (n,) what each block of `cells` (n, 512) needs: NOTHING, BARE or ROW."""
    for i in range(cells.shape[0]):
        out[i] = need(cells[i], unknown, lowest)


@kernel
def put(table, coords, values, count, wanted, cells, kinds):
    """Set blocks `wanted` (n, 3) to `cells` (n, 512), each stored according to `kinds` (n,)."""
    for i in range(wanted.shape[0]):
        x, y, z = wanted[i, 0], wanted[i, 1], wanted[i, 2]
        forget(table, coords, values, count, x, y, z)
        if kinds[i] == ROW:
            copy_row(values[new_row(table, coords, count, x, y, z)], cells[i])
        elif kinds[i] == BARE:
            place = values.shape[0] + count[1]
            coords[place, 0], coords[place, 1], coords[place, 2] = x, y, z
            enter(table, coords, place)
            count[1] += 1


@kernel
def remove(table, coords, values, count, gone):
    """Remove blocks `gone` (n, 3), whether present or not."""
    for i in range(gone.shape[0]):
        forget(table, coords, values, count, gone[i, 0], gone[i, 1], gone[i, 2])


@kernel
def find_all(table, coords, wanted, places):
    """Write the places of blocks `wanted` (n, 3) to `places` (n,), -1 if there is none."""
    for i in range(wanted.shape[0]):
        places[i] = find(table, coords, wanted[i, 0], wanted[i, 1], wanted[i, 2])


@cell
def need(block, unknown, lowest):
    """Return what a block of 512 stored numbers needs: NOTHING, BARE or ROW."""
    known, above = np.int16(0), np.int16(0)
    for c in range(512):
        number = np.int16(block[c])
        known = np.int16(known | np.int16(number ^ np.int16(unknown)))
        above = np.int16(above | np.int16(number ^ np.int16(lowest)))
    if above == 0:
        return BARE
    return NOTHING if known == 0 else ROW


@cell
def new_row(table, coords, count, x, y, z):
    """Create and return the row of a missing block; its numbers are yet to be written."""
    row = count[0]
    coords[row, 0], coords[row, 1], coords[row, 2] = x, y, z
    enter(table, coords, row)
    count[0] = row + 1
    return row


@cell
def with_row(table, coords, values, count, place, lowest):
    """Return the row of the block at `place`, creating one if it is bare."""
    if place < values.shape[0]:
        return place
    row = count[0]
    values[row] = lowest
    _move(table, coords, place, row)
    count[0] = row + 1
    _close_bare_gap(table, coords, values, count, place)
    return row


@cell
def make_bare(table, coords, values, count, row):
    """Remove the row of a block whose cells are all at the floor value; another block may get that row."""
    _move(table, coords, row, values.shape[0] + count[1])
    count[1] += 1
    _close_row_gap(table, coords, values, count, row)


@cell
def forget(table, coords, values, count, x, y, z):
    """Remove block (x, y, z) from the pool, whether present or not."""
    slot = slot_of(table, coords, x, y, z)
    if slot >= 0:
        place = np.int64(table[slot])
        empty_slot(table, coords, slot)
        if place < values.shape[0]:
            _close_row_gap(table, coords, values, count, place)
        else:
            _close_bare_gap(table, coords, values, count, place)


@cell
def _move(table, coords, old, new):
    """Move the block at place `old` to place `new`."""
    table[slot_of(table, coords, coords[old, 0], coords[old, 1], coords[old, 2])] = new
    coords[new, 0], coords[new, 1], coords[new, 2] = coords[old, 0], coords[old, 1], coords[old, 2]


@cell
def _close_row_gap(table, coords, values, count, row):
    last = count[0] - 1
    if row != last:
        _move(table, coords, last, row)
        copy_row(values[row], values[last])
    count[0] = last


@cell
def _close_bare_gap(table, coords, values, count, place):
    last = values.shape[0] + count[1] - 1
    if place != last:
        _move(table, coords, last, place)
    count[1] -= 1


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
def remove_times(table, coords, times, count, gone):
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
