# SPDX-License-Identifier: Apache-2.0
"""Kernel that casts rays against a map: block by block, and cell by cell if a block can stop the ray.

A ray's position is in cells: start + t * slope, t in metres; it meets a face at (face - start) * per_cell
(Amanatides and Woo 1987). A zero slope counts as forward and meets no face.
"""

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell
from stereovox.maps.cells._cells import number_in
from stereovox.maps.query._query import (
    LATELY,
    NOWHERE,
    UNKNOWN_BIT,
    cells_from_zero,
    extent,
    level_of,
    row_again,
    state_of,
)

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
