# SPDX-License-Identifier: Apache-2.0
"""Kernels that scatter measured points into their cells, and weigh how much of each cell they fill.

Most pixels fall into the cell of their left or upper neighbour. Each pixel's cell is packed into one number, and only
pixels whose number differs from their neighbours' are looked at further; groups without any cost one test.
"""

import numpy as np

from stereovox._jit import cell, kernel
from stereovox.integrate._cells import HALF, NEAR_PLANE, NO_RETURN, ONE, ZERO, table_row
from stereovox.integrate._keys import NARROW, WIDE, bits, unpack
from stereovox.maps._cells import find_or_insert

LEFT, RIGHT = 2, 1
"""Entries before and behind a row of keys, so that every pixel has neighbours."""
SEEN_BITS = 11
SEEN = 1 << SEEN_BITS
GROUP = 8
"""Pixels tested together, as one 64-bit word of eight flags."""
NOTHING = -1
"""Key of a pixel without a measurement."""
SIDE_SAMPLES = 4
"""Samples along each side of a cell's footprint, at most."""


@kernel
def scatter(depth_m, view, keys, news, fresh, seen, pool_table, coords, count, values):
    """Set every cell that holds a measured point to 1; return False when the block pool is full.

    depth_m: (h, w) REP 117 depth image. keys: (2, LEFT + w rounded up to GROUP + RIGHT) scratch; int32 serves cells
    within 2^9 of the camera, int64 the rest. news, fresh: scratch of one row, uint8 and int32, w rounded up to GROUP
    and one more for `fresh`. seen: (SEEN,) scratch of the keys' kind. Blocks count from the camera's own.
    """
    size = np.float32(1) / view.voxel_size
    position = view.position[0] * size, view.position[1] * size, view.position[2] * size
    last, place = (np.int32(0), np.int32(0), np.int32(0)), np.int64(-1)
    b = np.int64(bits(keys))
    keys[:, :] = NOTHING
    seen[:] = NOTHING
    for v in range(depth_m.shape[0]):
        now, before = keys[v & 1], keys[1 - (v & 1)]
        ray = _row_rays(view.forward, view.rows[v], size)
        if keys.itemsize == 4:
            _narrow_keys(depth_m[v], view.columns, ray, position, now[LEFT:])
        else:
            _wide_keys(depth_m[v], view.columns, ray, position, now[LEFT:])
        _mark_news(now, before, news)
        for i in range(_gather_news(news, fresh)):
            key = now[LEFT + fresh[i]]
            slot = _slot(key)
            if seen[slot] == key:
                continue
            seen[slot] = key
            x, y, zz = unpack(key, b)
            block = (x >> 3, y >> 3, zz >> 3)
            if place < 0 or block != last:
                place = find_or_insert(pool_table, coords, count, block[0], block[1], block[2])
                last = block
            if place < 0:
                return False
            values[place, ((x & 7) << 6) | ((y & 7) << 3) | (zz & 7)] = 1
    return True


@kernel
def weigh(depth_m, view, table, full_share, coords, count, values):
    """Replace the ones that `scatter` set by evidence: that of a hit at the depth of the cell's centre.

    It counts in full where at least `full_share` of the cell's footprint in the image measures a depth within the cell;
    with less, by the square root of the part: a few pixels may be a slip of the matcher. full_share 0: always in full.
    """
    side = np.float32(8) * view.voxel_size
    R, rows = view.rotation, table.hit.size
    for i in range(count[0]):
        px = np.float32(coords[i, 0]) * side - view.position[0]
        py = np.float32(coords[i, 1]) * side - view.position[1]
        pz = np.float32(coords[i, 2]) * side - view.position[2]
        cx = (R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz) * view.intrinsics[0]
        cy = (R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz) * view.intrinsics[1]
        cz = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        out = values[i]
        for c in range(512):
            if out[c] == 0:
                continue
            z = max(cz + view.steps[2, c], NEAR_PLANE)
            hit = np.float32(table.hit[table_row(min(z, view.max_range), table.rows_per_metre, rows)])
            if full_share > ZERO and hit > ZERO:
                share = _share(depth_m, view, cx + view.steps[0, c], cy + view.steps[1, c], z)
                hit *= np.sqrt(min(ONE, share / full_share))
            out[c] = np.int16(max(np.floor(hit + HALF), ONE)) if hit > ZERO else np.int16(0)


@cell
def _share(depth_m, view, x, y, z):
    """Return the part of a cell's footprint whose pixels measure a depth within half a cell of its centre.

    x, y: of the cell's centre, times the focal length. Samples stand at even distances; at least half of one counts.
    """
    inverse = ONE / z
    wide = min(view.voxel_size * view.intrinsics[0] * inverse, np.float32(depth_m.shape[1]))
    u0 = x * inverse + view.intrinsics[2] + HALF - HALF * wide
    v0 = y * inverse + view.intrinsics[3] + HALF - HALF * wide
    n = min(max(np.int32(wide), np.int32(1)), np.int32(SIDE_SAMPLES))
    step = wide / np.float32(n)
    limit = HALF * view.voxel_size
    found, looked = np.int32(0), np.int32(0)
    for j in range(n):
        v = np.int32(np.floor(v0 + (np.float32(j) + HALF) * step))
        if v < 0 or v >= depth_m.shape[0]:
            continue
        for k in range(n):
            u = np.int32(np.floor(u0 + (np.float32(k) + HALF) * step))
            if u < 0 or u >= depth_m.shape[1]:
                continue
            looked += 1
            found += 1 if abs(depth_m[v, u] - z) <= limit else 0
    return max(np.float32(found), HALF) / np.float32(max(looked, np.int32(1)))


@cell
def _slot(key):
    """Return where a key stands in `seen`: a small memory of the cells entered lately."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(mixed >> np.uint64(64 - SEEN_BITS))


@cell
def _row_rays(forward, row, size):
    """Return, in cells, how the world point of a pixel of this row at depth 1 depends on its column: slope, offset.

    row: (2,) y and z of the row's rays at depth 1; see `stereovox.cameras`.
    """
    y, z = row[0], row[1]
    return (
        forward[0, 0] * size, (forward[1, 0] * y + forward[2, 0] * z) * size,
        forward[0, 1] * size, (forward[1, 1] * y + forward[2, 1] * z) * size,
        forward[0, 2] * size, (forward[1, 2] * y + forward[2, 2] * z) * size,
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
def _wide_keys(depths, columns, ray, position, keys):
    """Pack each pixel's cell into an int64."""
    middle = np.int64(1 << (WIDE - 1))
    for u in range(depths.size):
        d = depths[u]
        x, y, z = _point_cell(d, columns[u], ray, position)
        key = ((np.int64(x) + middle) << (2 * WIDE)) | ((np.int64(y) + middle) << WIDE) | (np.int64(z) + middle)
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
