# SPDX-License-Identifier: Apache-2.0
"""Kernel that scatters measured points into their cells.

Most pixels fall into the cell of their left or upper neighbour. Each pixel's cell is packed into one number, and only
pixels whose number differs from their neighbours' are looked at further; groups without any cost one test.
"""

import numpy as np

from stereovox._jit import cell, kernel
from stereovox.integrate._cells import NO_RETURN, ZERO, table_row
from stereovox.maps._cells import find_or_insert

LEFT, RIGHT = 2, 1
"""Entries before and behind a row of keys, so that every pixel has neighbours."""
SEEN_BITS = 11
SEEN = 1 << SEEN_BITS
GROUP = 8
"""Pixels tested together, as one 64-bit word of eight flags."""
NOTHING = -1
"""Key of a pixel without a measurement."""
NARROW = 10
"""Bits for each cell coordinate in an int32 key, which has no room for the table row."""
WIDE = 19
"""Bits for each cell coordinate in an int64 key."""
ROW_BITS = 7
"""Bits for the table row in an int64 key."""


@kernel
def scatter(depth_m, view, table, keys, news, fresh, seen, pool_table, coords, count, values, first_row, last_row):
    """Give every cell that holds a measured point its hit evidence; return False when the block pool is full.

    depth_m: (h, w) REP 117 depth image. keys: (2, LEFT + w rounded up to GROUP + RIGHT) scratch; int32 serves cells
    within 2^9 of the camera when `table.hit` is one number for all depths, int64 the rest. news, fresh: scratch of one
    row, uint8 and int32, w rounded up to GROUP and one more for `fresh`. seen: (SEEN,) scratch of the keys' kind.
    Blocks count from the camera's own.
    """
    size = np.float32(1) / view.voxel_size
    position = view.position * size
    last, place = (np.int32(0), np.int32(0), np.int32(0)), np.int64(-1)
    rows = table.hit.size
    keys[:, :] = NOTHING
    seen[:] = NOTHING
    for v in range(first_row, last_row):
        now, before = keys[v & 1], keys[1 - (v & 1)]
        ray = _row_rays(view.rotation, view.rows[v], size)
        if keys.itemsize == 4:
            _narrow_keys(depth_m[v], view.columns, ray, position, now[LEFT:])
        else:
            _wide_keys(depth_m[v], view.columns, ray, position, table, now[LEFT:])
        _mark_news(now, before, news)
        for i in range(_gather_news(news, fresh)):
            u = fresh[i]
            key = now[LEFT + u]
            slot = _slot(key)
            if seen[slot] == key:
                continue
            seen[slot] = key
            d = depth_m[v, u]
            x, y, zz = _point_cell(d, view.columns[u], ray, position)
            block = (x >> 3, y >> 3, zz >> 3)
            if place < 0 or block != last:
                place = find_or_insert(pool_table, coords, count, block[0], block[1], block[2])
                last = block
            if place < 0:
                return False
            c = ((x & 7) << 6) | ((y & 7) << 3) | (zz & 7)
            hit = table.hit[table_row(d, table.rows_per_metre, rows)]
            values[place, c] = max(np.int32(values[place, c]), hit)
    return True


@cell
def _slot(key):
    """Return where a key stands in `seen`: a small memory of the cells entered lately."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(mixed >> np.uint64(64 - SEEN_BITS))


@cell
def _row_rays(rotation, slope, size):
    """Return, in cells, how the world point of a pixel of this row at depth 1 depends on its x/z: slope and offset."""
    return (
        rotation[0, 0] * size, (rotation[1, 0] * slope + rotation[2, 0]) * size,
        rotation[0, 1] * size, (rotation[1, 1] * slope + rotation[2, 1]) * size,
        rotation[0, 2] * size, (rotation[1, 2] * slope + rotation[2, 2]) * size,
    )  # fmt: skip


@cell
def _point_cell(d, column, ray, position):
    """Return the cell that holds the point at depth `d` of the pixel with x/z `column`."""
    return (
        np.int32(np.floor(d * (ray[0] * column + ray[1]) + position[0])),
        np.int32(np.floor(d * (ray[2] * column + ray[3]) + position[1])),
        np.int32(np.floor(d * (ray[4] * column + ray[5]) + position[2])),
    )


@cell
def _narrow_keys(depths, columns, ray, position, keys):
    """Pack each pixel's cell into an int32; offsets keep all numbers positive, so cutting off digits is the floor."""
    middle = np.float32(1 << (NARROW - 1))
    x0, y0, z0 = position[0] + middle, position[1] + middle, position[2] + middle
    for u in range(depths.size):
        d = depths[u]
        x = np.int32(d * (ray[0] * columns[u] + ray[1]) + x0)
        y = np.int32(d * (ray[2] * columns[u] + ray[3]) + y0)
        z = np.int32(d * (ray[4] * columns[u] + ray[5]) + z0)
        key = (x << np.int32(2 * NARROW)) | (y << np.int32(NARROW)) | z
        keys[u] = key if (d > ZERO) & (d < NO_RETURN) else np.int32(NOTHING)


@cell
def _wide_keys(depths, columns, ray, position, table, keys):
    """Pack each pixel's cell and table row into an int64."""
    middle = np.int64(1 << (WIDE - 1))
    rows = table.hit.size
    for u in range(depths.size):
        d = depths[u]
        x, y, z = _point_cell(d, columns[u], ray, position)
        key = ((np.int64(x) + middle) << (2 * WIDE)) | ((np.int64(y) + middle) << WIDE) | (np.int64(z) + middle)
        key = (key << ROW_BITS) | np.int64(table_row(d, table.rows_per_metre, rows))
        keys[u] = key if (d > ZERO) & (d < NO_RETURN) else np.int64(NOTHING)


@cell
def _mark_news(now, before, news):
    """Set `news` where a pixel holds a measurement and its key differs from those of five pixels seen before.

    Five, because noise makes the pixels of a surface near a cell's face fall into two cells by turns.
    """
    for u in range(news.size):
        i = u + LEFT
        key = now[i]
        beside = (key != now[i - 1]) & (key != now[i - 2])
        above = (key != before[i]) & (key != before[i - 1]) & (key != before[i + 1])
        news[u] = np.uint8(beside & above & (key != NOTHING))


@cell
def _gather_news(news, fresh):
    """List the pixels that are news; return how many. Free of unforeseeable branches within a group."""
    groups = news.view(np.uint64)
    n = 0
    for group in range(groups.size):
        if groups[group] != 0:
            for u in range(GROUP * group, GROUP * group + GROUP):
                fresh[n] = u
                n += news[u]
    return n
