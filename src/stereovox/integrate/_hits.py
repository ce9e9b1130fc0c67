# SPDX-License-Identifier: Apache-2.0
"""Kernel that scatters measured points into their cells."""

import numpy as np

from stereovox._jit import cell, kernel
from stereovox.integrate._cells import NO_RETURN, ZERO, table_row
from stereovox.maps._cells import find_or_insert

GROUP = 32
"""Pixels looked at together: most groups hold no new cell and cost one test."""
OFFSET = np.int64(1 << 18)
"""Added to cell indices so that a packed key has no negative part; cells lie within this many of the camera."""
NO_KEY = np.int64(-1)
WITHIN_BLOCK = np.int64((7 << 45) | (7 << 26) | 0x3FF)
"""Bits of a packed key that tell cells of one block apart: the low three of x, y and z, and the table row."""


@kernel
def scatter(z, view, table, keys, pool_table, coords, count, values, first_row, last_row):
    """Give every cell that holds a measured point its hit evidence; return False when the block pool is full.

    z: (h, w) depths, 0 none; keys: (2, w) int64 scratch. Blocks count from the camera's own. A pixel whose cell and
    table row equal those of its left or upper neighbour brings nothing new and is skipped.
    """
    room = True
    size = np.float32(1) / view.voxel_size
    rotation, position = view.rotation, view.position * size
    last_block = NO_KEY
    place = np.int64(-1)
    keys[:, :] = NO_KEY
    for v in range(first_row, last_row):
        now, before = keys[v & 1], keys[1 - (v & 1)]
        _row_keys(z[v], view.columns, view.rows[v], rotation, position, size, table, now)
        for start in range(0, z.shape[1], GROUP):
            stop = min(start + GROUP, z.shape[1])
            news = now[start] != before[start]
            for u in range(max(start, 1), stop):
                news |= (now[u] != before[u]) & (now[u] != now[u - 1])
            if not news:
                continue
            for u in range(start, stop):
                key = now[u]
                if key < 0 or key == before[u] or (u > 0 and key == now[u - 1]):
                    continue
                block = key & ~WITHIN_BLOCK
                x, y, zz = key_cell(key)
                if block != last_block:
                    place = find_or_insert(pool_table, coords, count, x >> 3, y >> 3, zz >> 3)
                    last_block = block
                if place < 0:
                    room = False
                    last_block = NO_KEY
                    continue
                c = ((x & 7) << 6) | ((y & 7) << 3) | (zz & 7)
                hit = table.hit[key & 127]
                values[place, c] = max(np.int32(values[place, c]), hit)
    return room


@cell
def key_cell(key):
    """Return the cell of a packed key."""
    return (
        np.int32(((key >> 45) & 0x7FFFF) - OFFSET),
        np.int32(((key >> 26) & 0x7FFFF) - OFFSET),
        np.int32(((key >> 7) & 0x7FFFF) - OFFSET),
    )


@cell
def _row_keys(depths, columns, slope, rotation, position, size, table, keys):
    ax, ay, az = rotation[0, 0] * size, rotation[0, 1] * size, rotation[0, 2] * size
    bx = (rotation[1, 0] * slope + rotation[2, 0]) * size
    by = (rotation[1, 1] * slope + rotation[2, 1]) * size
    bz = (rotation[1, 2] * slope + rotation[2, 2]) * size
    px, py, pz = position[0], position[1], position[2]
    rows = table.hit.size
    for u in range(depths.size):
        d = depths[u]
        x = np.int64(np.int32(np.floor(d * (ax * columns[u] + bx) + px)))
        y = np.int64(np.int32(np.floor(d * (ay * columns[u] + by) + py)))
        z = np.int64(np.int32(np.floor(d * (az * columns[u] + bz) + pz)))
        row = np.int64(table_row(d, table.rows_per_metre, rows))
        key = ((x + OFFSET) << 45) | ((y + OFFSET) << 26) | ((z + OFFSET) << 7) | row
        keys[u] = key if (d > ZERO) & (d < NO_RETURN) else NO_KEY
