# SPDX-License-Identifier: Apache-2.0
"""Kernel that finds the cell nearest to a point: in its block, then in shells of blocks around it."""

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell
from stereovox.maps.cells._cells import EMPTY
from stereovox.maps.query._query import LATELY, NOWHERE, UNKNOWN_BIT, level_of, row_again

ZERO, ONE, BYTE = np.uint64(0), np.uint64(1), np.uint64(255)


@allocating_kernel
def nearest(stored, rules, wanted, side, points, farthest, distance, cells):
    """Write the distance from each of `points` (n, 3) to the nearest wanted cell, and the cell (n, 3).

    wanted: (1,) uint8, bits of states. Points without one within `farthest` are left unchanged.
    """
    lately = np.full(LATELY, NOWHERE, np.int32)
    marks = np.empty((stored.values.shape[0], 1, 8), np.uint64)
    levels = np.zeros(stored.values.shape[0], np.int8)
    for i in range(points.shape[0]):
        p = (points[i, 0], points[i, 1], points[i, 2])
        square, x, y, z = _nearest(stored, rules, wanted, side, p, farthest, lately, marks, levels)
        if square < np.inf:
            distance[i] = np.sqrt(square)
            cells[i, 0], cells[i, 1], cells[i, 2] = x, y, z


@cell
def _nearest(stored, rules, wanted, side, p, farthest, lately, marks, levels):
    """Return the squared distance of the nearest wanted cell, infinite if none is near enough, and the cell.

    Once more blocks were visited than the hash has slots, the shells are mostly empty, and the existing rows are
    scanned instead. This cannot happen if missing blocks are wanted: one would have been found long before.
    """
    hx, hy, hz = _home(p[0], side[0]), _home(p[1], side[1]), _home(p[2], side[2])
    best = (np.inf, hx, hy, hz)
    within = farthest * farthest
    asked, shell = 0, 0
    while _to_shell(p, side, hx, hy, hz, shell) <= np.sqrt(min(best[0], within)):
        for bx in range(hx - shell, hx + shell + 1):
            gx = _gap(p[0], 8 * bx, 8, side[0])
            for by in range(hy - shell, hy + shell + 1):
                gy = _gap(p[1], 8 * by, 8, side[1])
                asked += 1
                if gx * gx + gy * gy > min(best[0], within):
                    continue
                side_on = (abs(bx - hx) == shell) | (abs(by - hy) == shell)
                for bz in range(hz - shell, hz + shell + 1, 1 if side_on else 2 * shell):
                    best = _nearer(stored, rules, wanted, side, p, bx, by, bz, within, best, lately, marks, levels)
                    asked += 1
        if asked > stored.table.size and (wanted[0] & UNKNOWN_BIT) == 0:
            return _nearest_of_rows(stored, rules, wanted, side, p, within, best, lately, marks, levels)
        shell += 1
    return best


@cell
def _nearest_of_rows(stored, rules, wanted, side, p, within, best, lately, marks, levels):
    for i in stored.table:
        if i != EMPTY:
            bx, by, bz = np.int64(stored.coords[i, 0]), np.int64(stored.coords[i, 1]), np.int64(stored.coords[i, 2])
            best = _nearer(stored, rules, wanted, side, p, bx, by, bz, within, best, lately, marks, levels)
    return best


@cell
def _nearer(stored, rules, wanted, side, p, bx, by, bz, within, best, lately, marks, levels):
    """Return the nearest to p within `within`: `best`, or a cell of a block."""
    gx, gy, gz = _gap(p[0], 8 * bx, 8, side[0]), _gap(p[1], 8 * by, 8, side[1]), _gap(p[2], 8 * bz, 8, side[2])
    square = gx * gx + gy * gy + gz * gz
    if not (square < best[0] and square <= within):
        return best
    row = row_again(stored, lately, bx, by, bz)
    if level_of(stored, rules, wanted, row, marks, levels) < 0:
        return best
    if row < 0:
        return square, _cell_in(p[0], side[0], bx), _cell_in(p[1], side[1], by), _cell_in(p[2], side[2], bz)
    for x in range(8 * bx, 8 * bx + 8):
        gx = _gap(p[0], x, 1, side[0])
        if marks[row, 0, x & 7] == ZERO or not gx * gx < best[0]:
            continue
        for y in range(8 * by, 8 * by + 8):
            column = (marks[row, 0, x & 7] >> np.uint64(8 * (y & 7))) & BYTE
            gy = _gap(p[1], y, 1, side[1])
            if column == ZERO or not gx * gx + gy * gy < best[0]:
                continue
            for z in range(8 * bz, 8 * bz + 8):
                gz = _gap(p[2], z, 1, side[2])
                square = gx * gx + gy * gy + gz * gz
                marked = (column >> np.uint64(z & 7)) & ONE != ZERO
                if marked & (square < best[0]) & (square <= within):
                    best = (square, x, y, z)
    return best


@cell
def _home(place, side):
    return np.int64(np.floor(place / side)) >> 3


@cell
def _cell_in(place, side, block):
    """Return the cell of a block that is nearest on one axis."""
    return min(max(np.int64(np.floor(place / side)), 8 * block), 8 * block + 7)


@cell
def _gap(place, first, n, side):
    """Return how far a place is from n cells on one axis."""
    return max(max(first * side - place, place - (first + n) * side), 0.0)


@cell
def _to_shell(p, side, hx, hy, hz, shell):
    """Return the least distance of a shell of blocks; 0 for the home block."""
    if shell == 0:
        return 0.0
    x = min((hx + shell) * 8 * side[0] - p[0], p[0] - (hx - shell + 1) * 8 * side[0])
    y = min((hy + shell) * 8 * side[1] - p[1], p[1] - (hy - shell + 1) * 8 * side[1])
    z = min((hz + shell) * 8 * side[2] - p[2], p[2] - (hz - shell + 1) * 8 * side[2])
    return min(x, min(y, z))
