# SPDX-License-Identifier: Apache-2.0
"""Kernels of scan beams: their lines, and the cells that these cross.

Unlike elsewhere, numbers are float64: beams are walked one by one, so wide registers gain nothing, and cells far from
the origin keep their edges. Positions are in cells, multiples of 2^-20, so that differences are exact.

Kernel that walks rays from one point through cubic cells (Amanatides and Woo 1987), in float64.
"""

from __future__ import annotations

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell, kernel

UNSIGNED = np.uint64
"""Index type that avoids the test for negative indices."""
GRAIN = 2.0**20
"""Coordinates are multiples of 1 / GRAIN cells."""
ZERO = np.float32(0)
SIDE_BITS = 6
SIDE = 1 << SIDE_BITS
POINT = 48
ONE = 2.0**POINT
"""Lines run in fixed point with POINT fractional bits: after 4,096 cells they are off by 2^-36."""
CORNER = 1 << (POINT - 35)
"""A line that passes a corner of cells this closely touches two of the four cells."""


@cell
def _grain(place):
    """Return a coordinate rounded to a multiple of 1 / GRAIN."""
    return np.rint(place * GRAIN) / GRAIN


@kernel
def aim(ranges, clear, clear_from, directions, turn, position, limits, behind, free, hits, taken_back, reads, box):
    """Write where beams clear and where they hit, as lines (n, 4) from x, y to x, y in cells; return how many of each.

    directions: (N, 2) cosines and sines in the sensor's frame. turn: (2, 2) from there to cells. position: (2,) of the
    sensor in cells. limits: (3,) float32 nearest range that counts, farthest that counts, farthest that the sensor
    measures. clear: (N,), or empty if ranges alone decide; clear_from: (N,), or empty for the sensor.
    taken_back: points in cells that a beam both clears and hits. reads: (N, 6) start and end of the cleared part of
    each beam, and its hit; NaN for none. box: (4,) lowest column and row, highest column and row of all.
    """
    nearest, reach, farthest = limits[0], limits[1], limits[2]
    x, y = _grain(position[0]), _grain(position[1])
    lines, ends, both = 0, 0, 0
    low_x, low_y, high_x, high_y = np.floor(x), np.floor(y), np.floor(x), np.floor(y)
    for i in range(ranges.size):
        measured = ranges[i]
        hit = measured >= nearest and measured <= reach and measured > 0
        known = (
            measured if hit else reach if (measured > reach and (measured <= farthest or measured == np.inf)) else 0.0
        )
        if clear.size > 0:
            known = min(clear[i], measured if hit else reach) if clear[i] > 0 else 0.0
        dx = turn[0, 0] * directions[i, 0] + turn[0, 1] * directions[i, 1]
        dy = turn[1, 0] * directions[i, 0] + turn[1, 1] * directions[i, 1]
        to_x, to_y = _grain(position[0] + dx * known), _grain(position[1] + dy * known)
        since = max(clear_from[i], ZERO) if clear_from.size > 0 else ZERO
        known = known if since < known else 0.0
        reads[i] = np.nan
        if known > 0:
            from_x, from_y = _grain(position[0] + dx * since), _grain(position[1] + dy * since)
            reads[i, 0], reads[i, 1], reads[i, 2], reads[i, 3] = from_x, from_y, to_x, to_y
            free[lines, 0], free[lines, 1], free[lines, 2], free[lines, 3] = from_x, from_y, to_x, to_y
            lines += 1
            low_x, low_y = min(low_x, np.floor(to_x)), min(low_y, np.floor(to_y))
            high_x, high_y = max(high_x, np.floor(to_x)), max(high_y, np.floor(to_y))
        if hit:
            at_x, at_y = _grain(position[0] + dx * measured), _grain(position[1] + dy * measured)
            end = measured + behind
            end_x, end_y = _grain(position[0] + dx * end), _grain(position[1] + dy * end)
            reads[i, 4], reads[i, 5] = at_x, at_y
            hits[ends, 0], hits[ends, 1], hits[ends, 2], hits[ends, 3] = at_x, at_y, end_x, end_y
            ends += 1
            low_x, low_y = min(low_x, np.floor(at_x), np.floor(end_x)), min(low_y, np.floor(at_y), np.floor(end_y))
            high_x, high_y = max(high_x, np.floor(at_x), np.floor(end_x)), max(high_y, np.floor(at_y), np.floor(end_y))
            if known > 0 and np.floor(to_x) == np.floor(at_x) and np.floor(to_y) == np.floor(at_y):
                taken_back[both, 0], taken_back[both, 1] = at_x, at_y
                taken_back[both, 2], taken_back[both, 3] = at_x, at_y
                both += 1
    box[0], box[1], box[2], box[3] = low_x, low_y, high_x, high_y
    return lines, ends, both


@kernel
def lay_out(first, across, coords, values):
    """Zero the tiles `values` (n, 4096) of a patch, `across` tiles wide from tile `first` on; write their `coords`."""
    for i in range(coords.shape[0]):
        coords[i, 0] = first[0] + i % across
        coords[i, 1] = first[1] + i // across
        coords[i, 2] = 0
        values[i] = 0


@cell
def _give(values, place, gain, adding):
    """Add `gain` to a cell, or set the cell to it if `adding` is None."""
    if adding is None:
        values[place] = gain
    else:
        values[place] += gain


@cell
def _give_twice(values, place, other, gain, adding):
    """Give `gain` to two cells; only once if they are the same."""
    if adding is None:
        values[place] = gain
        values[other] = gain
    else:
        values[place] += gain
        values[other] += gain if other != place else values.dtype.type(0)


@allocating_kernel
def places(across, up):
    """Return the offset of each column and of each row in a patch of tiles: their sum is the index of a cell."""
    columns, rows = np.empty(across << SIDE_BITS, np.uint32), np.empty(up << SIDE_BITS, np.uint32)
    for x in range(columns.size):
        columns[x] = ((x >> SIDE_BITS) << 2 * SIDE_BITS) + (x & SIDE - 1)
    for y in range(rows.size):
        rows[y] = ((y >> SIDE_BITS) * across << 2 * SIDE_BITS) + ((y & SIDE - 1) << SIDE_BITS)
    return columns, rows


@kernel
def exact(lines, first, columns, rows, gain, adding, values):
    """Give `gain` to every cell that lines (n, 4) touch (the cells of Amanatides and Woo 1987).

    values: the cells of a patch of tiles, in order. first: (2,) its lowest column and row. columns, rows: see `places`.
    adding: 1 adds to the value of a cell, None replaces it.
    """
    left, bottom = float(first[0]), float(first[1])
    for n in range(lines.shape[0]):
        u0, v0, u1, v1 = lines[n, 0] - left, lines[n, 1] - bottom, lines[n, 2] - left, lines[n, 3] - bottom
        along, aside = columns, rows
        if abs(v1 - v0) > abs(u1 - u0):
            u0, v0, u1, v1, along, aside = v0, u0, v1, u1, rows, columns
        if u0 > u1:
            u0, v0, u1, v1 = u1, v1, u0, v0
        begin, last = int(u0), int(u1)
        slope = (v1 - v0) / (u1 - u0) if u1 > u0 else 0.0
        step = int(slope * ONE)  # towards zero: the line never leaves its box
        v = int(v0 * ONE) + int(slope * (begin + 1 - u0) * ONE)
        corner = CORNER if slope > 0 else -CORNER if slope < 0 else 0
        lowest = int(min(v0, v1))
        enters = aside[int(v0)]
        for i in range(begin, last):  # one layer of cells, from the line's entry to its exit
            place, leaves = along[UNSIGNED(i)], aside[UNSIGNED((v - corner) >> POINT)]
            _give_twice(values, place + enters, place + leaves, gain, adding)
            enters = aside[UNSIGNED(max((v + corner) >> POINT, lowest))]
            v += step
        _give_twice(values, along[last] + enters, along[last] + aside[int(v1)], gain, adding)


@kernel
def bresenham(lines, first, columns, rows, gain, adding, values):
    """Give `gain` to the cells of Bresenham's lines between the cells in which lines (n, 4) begin and end.

    Arguments as in `exact`. Lines start at the sensor's cell (IST 2019, II-B); ties stay on the near side.
    """
    left, bottom = float(first[0]), float(first[1])
    for n in range(lines.shape[0]):
        u0, v0 = np.floor(lines[n, 0]) - left, np.floor(lines[n, 1]) - bottom
        u1, v1 = np.floor(lines[n, 2]) - left, np.floor(lines[n, 3]) - bottom
        along, aside = columns, rows
        if abs(v1 - v0) > abs(u1 - u0):
            u0, v0, u1, v1, along, aside = v0, u0, v1, u1, rows, columns
        i, k = int(u0), int(v0)
        step = 1 if u1 >= u0 else -1
        turn = 1 if v1 >= v0 else -1
        length = int(abs(u1 - u0))
        slope = int(abs(v1 - v0) / max(length, 1) * ONE)
        v = int(ONE / 2) - 1  # one less: a tie stays on the near side
        for _ in range(length + 1):
            _give(values, along[UNSIGNED(i)] + aside[UNSIGNED(k + turn * (v >> POINT))], gain, adding)
            v += slope
            i += step


@allocating_kernel
def walk(origin, ends, first, steps, cells):
    """Write the cells of each ray, from the cell of `origin` (3,) to the cell of its end; coordinates are in cells.

    ends: (N, 3). first: (N,) int64, row of `cells` of each ray's first cell. steps: (N,) int64, number of faces that
    each crosses. cells: (M, 3) int64.
    """
    per_cell, next_face = np.empty(3), np.empty(3)
    at, step = np.empty(3, np.int64), np.empty(3, np.int64)
    for i in range(ends.shape[0]):
        for axis in range(3):
            ray = ends[i, axis] - origin[axis]
            at[axis] = np.int64(np.floor(origin[axis]))
            step[axis] = -1 if ray < 0 else 1
            per_cell[axis] = np.inf if ray == 0 else 1 / abs(ray)
            next_face[axis] = np.inf if ray == 0 else (at[axis] + (1 if ray > 0 else 0) - origin[axis]) / ray
        row = first[i]
        for axis in range(3):
            cells[row, axis] = at[axis]
        for n in range(1, steps[i] + 1):
            axis = 0
            if next_face[1] < next_face[axis]:
                axis = 1
            if next_face[2] < next_face[axis]:
                axis = 2
            at[axis] += step[axis]
            next_face[axis] += per_cell[axis]
            for k in range(3):
                cells[row + n, k] = at[k]
