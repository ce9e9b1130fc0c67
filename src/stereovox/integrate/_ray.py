# SPDX-License-Identifier: Apache-2.0
"""Kernels of the ray integrator: walk every pixel's ray cell by cell (Amanatides and Woo 1987; Chien 2020, Alg 2)."""

import numpy as np

from stereovox._jit import cell, kernel
from stereovox.integrate._cells import HALF, NO_RETURN, ONE, ZERO, stronger, table_row, usable
from stereovox.integrate._hits import _point_cell, _row_rays
from stereovox.maps._cells import find_or_insert

FRACTION_BITS = 10
"""Weighted evidence is summed in thousandths times 2^10: whole numbers, so the order of rays does not matter."""
FRACTION = np.float32(1 << FRACTION_BITS)
BEYOND = np.float32(1e30)


@kernel
def cast(depth_m, view, table, weight, pool_table, coords, count, values, first_row, last_row):
    """Add the evidence of all rays of rows first_row..last_row to an empty pool; return False when it is too small.

    depth_m: (h, w) REP 117 depth image. weight > 0: every ray adds its evidence to every cell it crosses, times
    min(1, weight * depth^2) (Chien 2020, Eq 3.21), in units of 1/1024 thousandths; 0: a cell keeps the strongest.
    Blocks count from the camera's own.
    """
    size = ONE / view.voxel_size
    position = view.position * size
    for v in range(first_row, last_row):
        ray = _row_rays(view.rotation, view.rows[v], size)
        for u in range(depth_m.shape[1]):
            d = usable(depth_m[v, u])
            if d > ZERO and not _walk(
                d, view.columns[u], ray, position, view, table, weight, pool_table, coords, count, values
            ):
                return False
    return True


@cell
def _walk(d, column, ray, position, view, table, weight, pool_table, coords, count, values):
    row = table_row(min(d, view.max_range), table.rows_per_metre, table.hit.size)
    real = d < NO_RETURN
    end = d + (table.reach[row] if table.marks else ZERO) if real else view.max_range
    dx, dy, dz = ray[0] * column + ray[1], ray[2] * column + ray[3], ray[4] * column + ray[5]
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    x, y, zz = np.int32(np.floor(position[0])), np.int32(np.floor(position[1])), np.int32(np.floor(position[2]))
    hx, hy, hz = _point_cell(d if real else ZERO, column, ray, position)
    sx, sy, sz = _step(dx), _step(dy), _step(dz)
    tx, ty, tz = (
        _crossing(x, sx, position[0], ix),
        _crossing(y, sy, position[1], iy),
        _crossing(zz, sz, position[2], iz),
    )
    entered = ZERO
    place = np.int64(-1)
    while True:
        left = min(min(tx, ty), tz)
        if place < 0:
            place = find_or_insert(pool_table, coords, count, x >> 3, y >> 3, zz >> 3)
            if place < 0:
                return False
        if not (real and x == hx and y == hy and zz == hz):
            middle = HALF * (entered + min(left, end))
            e = _evidence(middle, d, row, table)
            if e != 0:
                _give(values, place, x, y, zz, e, middle, weight)
        if left >= end:
            break
        entered = left
        if tx <= ty and tx <= tz:
            place = place if ((x + sx) ^ x) & ~7 == 0 else np.int64(-1)
            x += sx
            tx = _crossing(x, sx, position[0], ix)
        elif ty <= tz:
            place = place if ((y + sy) ^ y) & ~7 == 0 else np.int64(-1)
            y += sy
            ty = _crossing(y, sy, position[1], iy)
        else:
            place = place if ((zz + sz) ^ zz) & ~7 == 0 else np.int64(-1)
            zz += sz
            tz = _crossing(zz, sz, position[2], iz)
    if real:
        place = find_or_insert(pool_table, coords, count, hx >> 3, hy >> 3, hz >> 3)
        if place < 0:
            return False
        _give(values, place, hx, hy, hz, table.hit[row], d, weight)
    return True


@cell
def _inverse(direction):
    return ONE / direction if direction != ZERO else BEYOND


@cell
def _step(direction):
    return np.int32(1) if direction > ZERO else np.int32(-1)


@cell
def _crossing(index, step, start, inverse):
    """Return the depth at which the ray leaves cell `index` along this axis; a ray along the others never does."""
    if abs(inverse) >= BEYOND:
        return BEYOND
    return (np.float32(index + (np.int32(1) if step > 0 else np.int32(0))) - start) * inverse


@cell
def _evidence(z, d, row, table):
    columns = np.float32(table.clear.shape[1])
    t = (z - d) * table.columns_per_metre[row] + columns * HALF
    k = np.int32(min(max(t, ZERO), columns - ONE))
    return table.clear[row, k] + table.mark[row, k]


@cell
def _give(values, place, x, y, z, e, depth, weight):
    c = ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)
    if weight > ZERO:
        share = min(ONE, weight * depth * depth)
        values[place, c] += np.int32(np.floor(np.float32(e) * share * FRACTION + HALF))
    else:
        values[place, c] = stronger(values[place, c], e)


@kernel
def merge(values, other, places, weighted):
    """Add the blocks of `other` (n, 512) to `values` at `places`: sums when weighted, else the strongest."""
    for i in range(places.size):
        target = values[places[i]]
        for c in range(512):
            target[c] = target[c] + other[i, c] if weighted else stronger(target[c], other[i, c])


@kernel
def to_thousandths(values, bits, out):
    """Round sums with `bits` fraction bits to int16 thousandths."""
    half = np.int32((1 << bits) >> 1)
    for i in range(values.shape[0]):
        for c in range(512):
            out[i, c] = np.int16(min(max((values[i, c] + half) >> bits, -32767), 32767))
