# SPDX-License-Identifier: Apache-2.0
"""Kernels over tiles of 64x64 cells: add evidence, look cells up, draw them as one picture."""

import numpy as np

from stereovox.kernels._jit import cell, kernel
from stereovox.maps.cells._cells import FREE, OCCUPIED, UNKNOWN, added, find, find_or_insert

STEP = 0.7
"""Cells between two looks along a line: it never passes a row of cells that it crosses squarely."""


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


@cell
def stored_in(table, coords, cells, unknown, x, y):
    """Return the stored number of a cell (column, row)."""
    tile = find(table, coords, x >> 6, y >> 6, 0)
    return np.int32(cells[tile, ((y & 63) << 6) | (x & 63)]) if tile >= 0 else np.int32(unknown)


@cell
def seen_at(table, coords, cells, unknown, limits, x, y, around):
    """Return OCCUPIED if a cell, or one up to `around` columns and rows from it, is a surface, FREE or UNKNOWN else.

    limits: what is stored is a surface from (0) on, and free up to (1).
    """
    here = stored_in(table, coords, cells, unknown, x, y)
    if here >= limits[0]:
        return OCCUPIED
    for v in range(y - around, y + around + 1):
        for u in range(x - around, x + around + 1):
            if stored_in(table, coords, cells, unknown, u, v) >= limits[0]:
                return OCCUPIED
    return FREE if (here != unknown) & (here <= limits[1]) else UNKNOWN


@kernel
def see(table, coords, cells, unknown, limits, indices, around, out):
    """Write to `out` (n,) uint8 what is at each cell (column, row) of `indices` (n, 2) int64; see `seen_at`."""
    for i in range(indices.shape[0]):
        out[i] = seen_at(table, coords, cells, unknown, limits, indices[i, 0], indices[i, 1], around)


@cell
def share_until(table, coords, cells, unknown, least, x, y, to_x, to_y):
    """Return how far (0 to 1) a line runs until a known cell holds `least` or more; infinity if there is none.

    It is sampled every STEP cells at most, so corners that it cuts do not count.
    """
    steps = int(max(abs(to_x - x), abs(to_y - y)) / STEP) + 1
    at_x, at_y, tile = np.int64(1) << 40, np.int64(1) << 40, np.int64(-1)
    for k in range(steps + 1):
        share = k / steps
        column, row = int(np.floor(x + share * (to_x - x))), int(np.floor(y + share * (to_y - y)))
        if (column >> 6 != at_x) | (row >> 6 != at_y):
            at_x, at_y = column >> 6, row >> 6
            tile = find(table, coords, at_x, at_y, 0)
        number = cells[tile, ((row & 63) << 6) | (column & 63)] if tile >= 0 else unknown
        if number != unknown and number >= least:
            return share
    return np.inf


@kernel
def cast(table, coords, cells, unknown, least, lines, out):
    """Write to `out` (n,) how far lines (n, 4), in cells, run; see `share_until`."""
    for i in range(lines.shape[0]):
        out[i] = share_until(table, coords, cells, unknown, least, lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3])


@kernel
def weigh(table, coords, cells, unknown, limits, sure, around, deep, ends, step, out):
    """Count every `step`-th beam of a scan: write to `out` (4,) int64 how many agree with the grid, how many end in
    what is surely free, how many clear what is surely occupied, and how many there are.

    limits: as in `seen_at`, of what is surely free. sure: surely occupied from. ends: (N, 6), see `GridEvidence`. A
    beam agrees if a surface is within `around` cells of its hit; what it passes must be `deep` cells before its end.
    """
    agree, into, through, every = 0, 0, 0, 0
    for i in range(0, ends.shape[0], step):
        x, y, to_x, to_y, hit_x, hit_y = ends[i, 0], ends[i, 1], ends[i, 2], ends[i, 3], ends[i, 4], ends[i, 5]
        met = UNKNOWN
        if not np.isnan(hit_x):
            column, row = int(np.floor(hit_x)), int(np.floor(hit_y))
            met = seen_at(table, coords, cells, unknown, limits, column, row, around)
        length = np.hypot(to_x - x, to_y - y)  # not a number if it clears nothing
        every += 0 if np.isnan(hit_x) and np.isnan(length) else 1
        agree += 1 if met == OCCUPIED else 0
        into += 1 if met == FREE else 0
        if met == UNKNOWN and length > deep:
            share = 1 - deep / length
            end_x, end_y = x + share * (to_x - x), y + share * (to_y - y)
            through += 1 if share_until(table, coords, cells, unknown, sure, x, y, end_x, end_y) <= 1 else 0
    out[0], out[1], out[2], out[3] = agree, into, through, every
