# SPDX-License-Identifier: Apache-2.0
"""Kernels that find the worst cell in boxes and capsules.

Blocks are visited one by one, at most as many as the map is large: once more blocks were visited than the hash has
slots, a missing one was among them, and only blocks with a row can be worse.
"""

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell
from stereovox.maps.cells._cells import EMPTY
from stereovox.maps.query._query import LATELY, NOWHERE, cells_from_zero, level_of, row_again

UNKNOWN_LEVEL, WORST_LEVEL = np.int32(0), np.int32(2)
SLACK = 1e-9
"""Blocks this much farther off are visited too: contact is decided cell by cell."""
ZERO, ONE, EVERY_ROW = np.uint64(0), np.uint64(1), np.uint64(0x0101010101010101)


@allocating_kernel
def boxes(stored, rules, wanted, side, limit, low, high, out):
    """Write the level of the worst cell of each box to `out` (n,), -1 if all are free.

    low, high: (n, 3) corners. wanted: (3,) uint8 bit set of states of each level: unknown, and two worse ones.
    """
    lately = np.full(LATELY, NOWHERE, np.int32)
    marks = np.empty((stored.values.shape[0], 3, 8), np.uint64)
    levels = np.zeros(stored.values.shape[0], np.int8)
    for i in range(low.shape[0]):
        ax, bx, left_x = _span(low[i, 0], high[i, 0], side[0], limit)
        ay, by, left_y = _span(low[i, 1], high[i, 1], side[1], limit)
        az, bz, left_z = _span(low[i, 2], high[i, 2], side[2], limit)
        worst = UNKNOWN_LEVEL if left_x | left_y | left_z else np.int32(-1)
        box = (ax, ay, az, bx, by, bz)
        out[i] = _worst_in_box(stored, rules, wanted, box, worst, lately, marks, levels)


@allocating_kernel
def capsules(stored, rules, wanted, side, limit, begin, end, radius, out):
    """Write the level of the worst cell that each capsule touches to `out` (n,), -1 if all are free.

    begin, end: (n, 3) ends of the capsule's axis. radius: (n,), or (1,) for all. wanted: as for `boxes`.
    """
    lately = np.full(LATELY, NOWHERE, np.int32)
    marks = np.empty((stored.values.shape[0], 3, 8), np.uint64)
    levels = np.zeros(stored.values.shape[0], np.int8)
    for i in range(begin.shape[0]):
        a, r = begin[i], radius[min(i, radius.size - 1)]
        d = (end[i, 0] - a[0], end[i, 1] - a[1], end[i, 2] - a[2])
        solid = (a[0], a[1], a[2], d[0], d[1], d[2], r)
        worst = np.int32(-1)
        for axis in range(3):
            beyond = max(abs(a[axis]), abs(end[i, axis])) + r >= limit * side[axis]
            worst = UNKNOWN_LEVEL if beyond else worst
        out[i] = _worst_in_capsule(stored, rules, wanted, side, solid, worst, lately, marks, levels)


@cell
def _span(low, high, side, limit):
    """Return the first and the last cell from `low` to `high`, and whether cells beyond the limit were cut off."""
    first, last = np.floor(cells_from_zero(low, side)), np.floor(cells_from_zero(high, side))
    beyond = first <= -limit or last >= limit
    return np.int64(min(max(first, -limit), limit)), np.int64(min(max(last, -limit), limit)), beyond


@cell
def _worst_in_box(stored, rules, wanted, box, worst, lately, marks, levels):
    asked = 0
    for bx in range(box[0] >> 3, (box[3] >> 3) + 1):
        for by in range(box[1] >> 3, (box[4] >> 3) + 1):
            for bz in range(box[2] >> 3, (box[5] >> 3) + 1):
                worst = _worse_in_box(stored, rules, wanted, box, bx, by, bz, worst, lately, marks, levels)
                asked += 1
                if worst == WORST_LEVEL:
                    return worst
                if asked > stored.table.size and worst >= UNKNOWN_LEVEL:
                    return _worst_of_rows_in_box(stored, rules, wanted, box, worst, lately, marks, levels)
    return worst


@cell
def _worst_of_rows_in_box(stored, rules, wanted, box, worst, lately, marks, levels):
    for i in stored.table:
        if i == EMPTY:
            continue
        bx, by, bz = np.int64(stored.coords[i, 0]), np.int64(stored.coords[i, 1]), np.int64(stored.coords[i, 2])
        inside = (box[0] >> 3 <= bx) & (bx <= box[3] >> 3) & (box[1] >> 3 <= by) & (by <= box[4] >> 3)
        if inside & (box[2] >> 3 <= bz) & (bz <= box[5] >> 3):
            worst = _worse_in_box(stored, rules, wanted, box, bx, by, bz, worst, lately, marks, levels)
    return worst


@cell
def _worse_in_box(stored, rules, wanted, box, bx, by, bz, worst, lately, marks, levels):
    """Return the worst level of the cells of a block inside a box, or `worst` if none is worse."""
    row = row_again(stored, lately, bx, by, bz)
    top = level_of(stored, rules, wanted, row, marks, levels)
    if row < 0 or top <= worst:
        return max(top, worst)
    first_x, last_x = max(box[0] - 8 * bx, 0), min(box[3] - 8 * bx, 7)
    first_y, last_y = max(box[1] - 8 * by, 0), min(box[4] - 8 * by, 7)
    first_z, last_z = max(box[2] - 8 * bz, 0), min(box[5] - 8 * bz, 7)
    column = ((ONE << np.uint64(last_z - first_z + 1)) - ONE) << np.uint64(first_z)
    layer = column * ((EVERY_ROW >> np.uint64(8 * (7 - last_y + first_y))) << np.uint64(8 * first_y))
    for x in range(first_x, last_x + 1):
        for level in range(worst + 1, top + 1):
            worst = np.int32(level) if marks[row, level, x] & layer != ZERO else worst
    return worst


@cell
def _worst_in_capsule(stored, rules, wanted, side, solid, worst, lately, marks, levels):
    """Walk through the blocks around the axis: by x, within these by y, within these by z.

    The remaining axis and radius shrink at each level, so that few blocks are visited in vain.
    """
    asked = 0
    wide, deep, tall = 8 * side[0], 8 * side[1], 8 * side[2]
    reach = (1 + SLACK) * solid[6] + SLACK * min(side[0], min(side[1], side[2]))
    first_x, last_x = _blocks_about(solid[0], solid[3], 0.0, 1.0, reach, wide)
    for bx in range(first_x, last_x + 1):
        from_x, to_x, reach_x = _shrunk(solid[0], solid[3], 0.0, 1.0, reach, bx * wide, (bx + 1) * wide)
        first_y, last_y = _blocks_about(solid[1], solid[4], from_x, to_x, reach_x, deep)
        for by in range(first_y, last_y + 1):
            from_y, to_y, reach_y = _shrunk(solid[1], solid[4], from_x, to_x, reach_x, by * deep, (by + 1) * deep)
            first_z, last_z = _blocks_about(solid[2], solid[5], from_y, to_y, reach_y, tall)
            for bz in range(first_z, last_z + 1):
                worst = _worse_in_capsule(stored, rules, wanted, side, solid, bx, by, bz, worst, lately, marks, levels)
                asked += 1
                if worst == WORST_LEVEL:
                    return worst
                if asked > stored.table.size and worst >= UNKNOWN_LEVEL:
                    return _worst_of_rows_in_capsule(stored, rules, wanted, side, solid, worst, lately, marks, levels)
    return worst


@cell
def _worst_of_rows_in_capsule(stored, rules, wanted, side, solid, worst, lately, marks, levels):
    for i in stored.table:
        if i != EMPTY:
            bx, by, bz = np.int64(stored.coords[i, 0]), np.int64(stored.coords[i, 1]), np.int64(stored.coords[i, 2])
            worst = _worse_in_capsule(stored, rules, wanted, side, solid, bx, by, bz, worst, lately, marks, levels)
    return worst


@cell
def _blocks_about(start, slope, t, until, reach, width):
    """Return the first and the last block within `reach` of the segment from t to `until`, on one axis."""
    a, b = start + t * slope, start + until * slope
    return np.int64(np.ceil((min(a, b) - reach) / width)) - 1, np.int64(np.floor((max(a, b) + reach) / width))


@cell
def _shrunk(start, slope, t, until, reach, low, high):
    """Return the part of an axis that can be within `reach` of the slab low..high, and the remaining reach."""
    if slope != 0:
        a, b = (low - reach - start) / slope, (high + reach - start) / slope
        t, until = min(max(min(a, b), t), until), max(min(max(a, b), until), t)
    a, b = start + t * slope, start + until * slope
    gap = max(0.0, max(low - max(a, b), min(a, b) - high))
    return t, until, np.sqrt(max(reach * reach - gap * gap, 0.0))


@cell
def _worse_in_capsule(stored, rules, wanted, side, solid, bx, by, bz, worst, lately, marks, levels):
    """Return the worst level of the cells of a block that a capsule touches, or `worst` if none is worse."""
    row = row_again(stored, lately, bx, by, bz)
    top = level_of(stored, rules, wanted, row, marks, levels)
    if top <= worst or not _touches(solid, side, 8 * bx, 8 * by, 8 * bz, 8):
        return worst
    if row < 0:
        return top
    for level in range(top, worst, -1):
        for x in range(8):
            word = marks[row, level, x]
            c = 0
            while word != ZERO:
                if word & ONE != ZERO and _touches(solid, side, 8 * bx + x, 8 * by + (c >> 3), 8 * bz + (c & 7), 1):
                    return np.int32(level)
                word >>= ONE
                c += 1
    return worst


@cell
def _touches(solid, side, x, y, z, n):
    """Return whether a capsule comes within its radius of the n x n x n cells from (x, y, z).

    The distance along the axis is convex, and its slope has a bend wherever the axis crosses a face's plane: between
    the two bends around the minimum the slope is a straight line.
    """
    low = (x * side[0], y * side[1], z * side[2])
    high = ((x + n) * side[0], (y + n) * side[1], (z + n) * side[2])
    square = solid[6] * solid[6]
    off, half = _off_axis(solid, low, high)
    if off <= square or off > (solid[6] + half) * (solid[6] + half):
        return off <= square
    before, after = 0.0, 1.0
    near, falls = _distance(solid, low, high, before)
    end, rises = _distance(solid, low, high, after)
    if min(near, end) <= square:
        return True
    if falls >= 0 or rises <= 0:
        return False
    for axis in range(3):
        for face in (low[axis], high[axis]):
            t = (face - solid[axis]) / solid[3 + axis]
            if before < t < after:
                near, slope = _distance(solid, low, high, t)
                if near <= square:
                    return True
                if slope > 0:
                    after, rises = t, slope
                else:
                    before, falls = t, slope
    least, _ = _distance(solid, low, high, before - falls * (after - before) / (rises - falls))
    return least <= square


@cell
def _off_axis(solid, low, high):
    """Return the squared distance of the axis from the middle of a box, and half of the box's diagonal."""
    along, length, off, diagonal = 0.0, 0.0, 0.0, 0.0
    for axis in range(3):
        along += (0.5 * (low[axis] + high[axis]) - solid[axis]) * solid[3 + axis]
        length += solid[3 + axis] * solid[3 + axis]
    t = min(max(along / length, 0.0), 1.0) if length > 0 else 0.0
    for axis in range(3):
        away = 0.5 * (low[axis] + high[axis]) - solid[axis] - t * solid[3 + axis]
        off += away * away
        diagonal += (high[axis] - low[axis]) * (high[axis] - low[axis])
    return off, (1 + SLACK) * 0.5 * np.sqrt(diagonal)


@cell
def _distance(solid, low, high, t):
    """Return the squared distance of the axis at t from a box, and half of its slope in t."""
    square, slope = 0.0, 0.0
    for axis in range(3):
        place = solid[axis] + t * solid[3 + axis]
        off = max(place - high[axis], 0.0) - max(low[axis] - place, 0.0)
        square += off * off
        slope += off * solid[3 + axis]
    return square, slope
