# SPDX-License-Identifier: Apache-2.0
"""Shared by all queries: cells at points, states, a cache of rows, and marks on relevant cells.

Kernel that finds the cell nearest to a point: in its block, then in shells of blocks around it.

Kernel that casts rays against a map: block by block, and cell by cell if a block can stop the ray.

A ray's position is in cells: start + t * slope, t in metres; it meets a face at (face - start) * per_cell
(Amanatides and Woo 1987). A zero slope counts as forward and meets no face.
"""

from __future__ import annotations

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell, exact_cell
from stereovox.maps.cells import _cells
from stereovox.maps.cells._cells import EMPTY, NO_ROW, number_in, row_of

LATELY = (4096, 4)
NOWHERE = np.int32(2**30)
"""No block has this coordinate."""
UNKNOWN, TENTATIVE = np.int32(_cells.UNKNOWN), np.int32(_cells.TENTATIVE)
UNKNOWN_BIT = np.uint8(1 << _cells.UNKNOWN)
BIT, ONE, NO_BITS = np.uint8(1), np.int32(1), np.uint64(0)


@allocating_kernel
def look_up(stored, side, limit, points, out):
    """Write the stored number of the cell at each of `points` (n, 3) to `out` (n,).

    side: (3,) sides of a cell. Beyond +-`limit` cells all is unknown, and so is NaN.
    """
    far = np.float64(limit)
    lately = np.full(LATELY, NOWHERE, np.int32)
    for i in range(points.shape[0]):
        x = np.floor(cells_from_zero(points[i, 0], side[0]))
        y = np.floor(cells_from_zero(points[i, 1], side[1]))
        z = np.floor(cells_from_zero(points[i, 2], side[2]))
        if not (abs(x) < far and abs(y) < far and abs(z) < far):
            out[i] = stored.unknown
            continue
        ix, iy, iz = np.int64(x), np.int64(y), np.int64(z)
        out[i] = number_in(stored, row_again(stored, lately, ix >> 3, iy >> 3, iz >> 3), ix, iy, iz)


@exact_cell
def cells_from_zero(place, side):
    """Return a place in cells, rounded as in NumPy at faces."""
    return np.float64(place) / side


@cell
def row_again(stored, lately, bx, by, bz):
    """Do as `row_of`, from a cache if possible; 16 x 16 x 16 neighbouring blocks do not evict each other.

    lately: (4096, 4) int32 block coordinates and row, NOWHERE at first.
    """
    entry = ((bx & 15) << 8) | ((by & 15) << 4) | (bz & 15)
    if lately[entry, 0] != bx or lately[entry, 1] != by or lately[entry, 2] != bz:
        lately[entry, 0], lately[entry, 1], lately[entry, 2] = bx, by, bz
        lately[entry, 3] = row_of(stored, bx, by, bz)
    return np.int64(lately[entry, 3])


@cell
def state_of(stored, rules, number):
    """Return the `State` of a stored number, int32; rules: `Thresholds`."""
    above = ONE if number >= rules.occupied_least else np.int32(0)
    below = ONE if number <= rules.free_most else np.int32(0)
    return UNKNOWN if number == stored.unknown else np.int32(TENTATIVE + above - below)


@cell
def level_of(stored, rules, wanted, row, marks, levels):
    """Return the highest level among the cells of a block, -1 if none is wanted; `row` comes from `row_of`.

    Cells of a row are marked on first use; without a row all cells of a block have one level.
    wanted: (n,) uint8, for each level a bit set of its states.
    marks: (rows, n, 8) uint64, one word for each layer of x: bit 8 y + z. levels: (rows,) int8, 0 if not yet used.
    """
    if row < 0:
        return _level(wanted, UNKNOWN if row == NO_ROW else state_of(stored, rules, stored.lowest))
    if levels[row] == 0:
        levels[row] = _mark(stored, rules, wanted, row, marks) + np.int32(2)
    return np.int32(levels[row] - np.int32(2))


@cell
def _mark(stored, rules, wanted, row, marks):
    """Set the marks of a row; return its highest level, -1 if nothing is wanted."""
    highest = np.int32(-1)
    for level in range(wanted.size):
        found = NO_BITS
        for x in range(8):
            word = NO_BITS
            for bit in range(64):
                state = state_of(stored, rules, np.int32(stored.values[row, 64 * x + bit]))
                word |= np.uint64((wanted[level] >> np.uint8(state)) & BIT) << np.uint64(bit)
            marks[row, level, x] = word
            found |= word
        highest = np.int32(level) if found != NO_BITS else highest
    return highest


@cell
def _level(wanted, state):
    """Return the level of a state, -1 if it is not wanted."""
    highest = np.int32(-1)
    for level in range(wanted.size):
        highest = np.int32(level) if (wanted[level] >> np.uint8(state)) & BIT else highest
    return highest


@cell
def extent(stored, low, high):
    """Write the lowest and highest coordinates (3,) of all blocks with a row; low > high if there is none."""
    low[:] = NOWHERE
    high[:] = -NOWHERE
    for i in stored.table:
        if i != EMPTY:
            for axis in range(3):
                low[axis] = min(low[axis], stored.coords[i, axis])
                high[axis] = max(high[axis], stored.coords[i, axis])


ZERO, ONE_64, BYTE = np.uint64(0), np.uint64(1), np.uint64(255)


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
                marked = (column >> np.uint64(z & 7)) & ONE_64 != ZERO
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


LEVEL = 1e-300
"""Slopes up to this count as zero."""


@allocating_kernel
def cast(stored, rules, wanted, side, origins, directions, farthest, distance, cells, states):
    """Write each ray's length, the cell (n, 3) it stops in and that cell's state; rays that hit nothing are unchanged.

    wanted: (1,) uint8, bits of the states that stop a ray. origins: (n, 3), or (1, 3) for all rays.
    """
    lately = np.full(LATELY, NOWHERE, np.int32)
    marks = np.empty((stored.values.shape[0], 1, 8), np.uint64)
    levels = np.zeros(stored.values.shape[0], np.int8)
    low, high = np.empty(3, np.int32), np.empty(3, np.int32)
    inside_only = _worth_clipping(stored, wanted, side, directions.shape[0] * farthest)
    if inside_only:
        extent(stored, low, high)
    for i in range(directions.shape[0]):
        start, slope, per_cell, step = _aim(origins[min(i, origins.shape[0] - 1)], directions[i], side)
        t, end = np.float64(0), np.float64(farthest)
        if inside_only:
            t, end = _clip(start, per_cell, low, high, end)
        bx, by, bz = _at(start[0], slope[0], t) >> 3, _at(start[1], slope[1], t) >> 3, _at(start[2], slope[2], t) >> 3
        while t <= end:
            row = row_again(stored, lately, bx, by, bz)
            if level_of(stored, rules, wanted, row, marks, levels) >= 0:
                found, t, x, y, z = _walk(start, slope, per_cell, step, t, row, bx, by, bz, marks)
                if found:
                    if t <= end:
                        distance[i] = t
                        cells[i, 0], cells[i, 1], cells[i, 2] = x, y, z
                        states[i] = state_of(stored, rules, number_in(stored, row, x, y, z))
                    break
            tx = _meets(start[0], per_cell[0], (bx << 3) + (8 if step[0] > 0 else 0))
            ty = _meets(start[1], per_cell[1], (by << 3) + (8 if step[1] > 0 else 0))
            tz = _meets(start[2], per_cell[2], (bz << 3) + (8 if step[2] > 0 else 0))
            t = min(tx, min(ty, tz))
            on_x = (tx <= ty) & (tx <= tz)
            on_y = (ty <= tz) & (not on_x)
            bx += step[0] if on_x else 0
            by += step[1] if on_y else 0
            bz += 0 if on_x | on_y else step[2]


@cell
def _walk(start, slope, per_cell, step, t, row, bx, by, bz, marks):
    """Walk through a block entered at `t`; return whether a marked cell was hit, and where.

    A block without a row is wholly marked.
    """
    x = min(max(_at(start[0], slope[0], t), bx << 3), (bx << 3) + 7)
    y = min(max(_at(start[1], slope[1], t), by << 3), (by << 3) + 7)
    z = min(max(_at(start[2], slope[2], t), bz << 3), (bz << 3) + 7)
    tx = _meets(start[0], per_cell[0], x + (1 if step[0] > 0 else 0))
    ty = _meets(start[1], per_cell[1], y + (1 if step[1] > 0 else 0))
    tz = _meets(start[2], per_cell[2], z + (1 if step[2] > 0 else 0))
    while row >= 0:
        if (marks[row, 0, x & 7] >> np.uint64(((y & 7) << 3) | (z & 7))) & np.uint64(1):
            return True, t, x, y, z
        t = min(tx, min(ty, tz))
        on_x = (tx <= ty) & (tx <= tz)
        on_y = (ty <= tz) & (not on_x)
        on_z = not (on_x | on_y)
        x += step[0] if on_x else 0
        y += step[1] if on_y else 0
        z += step[2] if on_z else 0
        tx += abs(per_cell[0]) if on_x else 0.0
        ty += abs(per_cell[1]) if on_y else 0.0
        tz += abs(per_cell[2]) if on_z else 0.0
        if (x >> 3) != bx or (y >> 3) != by or (z >> 3) != bz:
            return False, t, x, y, z
    return True, t, x, y, z


@cell
def _aim(origin, direction, side):
    """Return a ray's start in cells, its slope in cells per metre, metres per cell, and its steps, three each."""
    x, y, z = direction[0], direction[1], direction[2]
    largest = max(abs(x), max(abs(y), abs(z)))
    x, y, z = x / largest, y / largest, z / largest  # no square overflows, and not all three vanish
    length = np.sqrt(x * x + y * y + z * z)
    slope = (x / length / side[0], y / length / side[1], z / length / side[2])
    start = (
        cells_from_zero(origin[0], side[0]),
        cells_from_zero(origin[1], side[1]),
        cells_from_zero(origin[2], side[2]),
    )
    per_cell = (_inverse(slope[0]), _inverse(slope[1]), _inverse(slope[2]))
    return start, slope, per_cell, (_sign(per_cell[0]), _sign(per_cell[1]), _sign(per_cell[2]))


@cell
def _inverse(slope):
    return 1.0 / slope if abs(slope) > LEVEL else np.inf


@cell
def _sign(per_cell):
    return 1 if per_cell > 0 else -1


@cell
def _at(start, slope, t):
    """Return the cell in which a ray is at `t`."""
    return np.int64(np.floor(start + slope * t))


@cell
def _meets(start, per_cell, face):
    """Return where a ray meets a face."""
    return (np.float64(face) - start) * per_cell


@cell
def _worth_clipping(stored, wanted, side, metres):
    """Return whether rays of that length visit more blocks than the table has slots, and pass through missing ones."""
    blocks = 3 * metres / (8 * min(side[0], min(side[1], side[2])))
    return blocks > stored.table.size and (wanted[0] & UNKNOWN_BIT) == 0


@cell
def _clip(start, per_cell, low, high, end):
    """Return the interval of a ray within blocks low..high, up to `end`; a negative end: it misses them."""
    t = np.float64(0)
    for axis in range(3):
        first, beyond = 8.0 * low[axis], 8.0 * (high[axis] + 1)
        if per_cell[axis] == np.inf:
            outside = not first <= start[axis] < beyond
        else:
            a, b = (first - start[axis]) * per_cell[axis], (beyond - start[axis]) * per_cell[axis]
            t, end = max(t, min(a, b)), min(end, max(a, b))
            outside = first >= beyond
        if outside:
            return t, np.float64(-1)
    return t, end
