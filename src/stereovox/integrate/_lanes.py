# SPDX-License-Identifier: Apache-2.0
"""Kernel cells shared by ray casting and line drawing: many rays side by side, and what they give to cells.

A step first finds, for all lanes, the key of the present cell and its evidence (`key`, `gain`): plain arithmetic, which
the compiler does for many lanes at once. Then gains are summed in runs: neighbouring rays mostly cross the same cell.
"""

import numpy as np

from stereovox._jit import cell, kernel
from stereovox.integrate._cells import HALF, NO_RETURN, ONE, ZERO, stronger, table_row, usable
from stereovox.integrate._hits import _point_cell
from stereovox.integrate._keys import bits, pack, unpack
from stereovox.maps._cells import find_or_insert

FRACTION_BITS = 10
"""Weighted evidence is summed in thousandths times 2^10: whole numbers, so the order of rays does not matter."""
FRACTION = np.float32(1 << FRACTION_BITS)
HALF_DIAGONAL = np.float32(0.8661)
"""Depth, in cells, from where a ray enters a cell to the middle of its way through it, at most."""


@cell
def aim(depths, columns, ray, position, view, table, lanes):
    """Fill depth, end, row, columns and hit of the lanes for a run of pixels.

    Return the depth up to which a cell may begin that all of them call plainly free; NO_RETURN when there is no ray.

    depths, columns: REP 117 depth and x/z of at most LANES pixels of one image row. ray: see `_row_rays`.
    """
    rows = table.hit.size
    free_to = NO_RETURN
    half_cell = HALF_DIAGONAL * view.voxel_size  # the cell of the measured point is never "plainly free"
    for i in range(lanes.depth.size):
        d = usable(depths[i]) if i < depths.size else ZERO
        real = d < NO_RETURN
        row = table_row(min(d, view.max_range), table.rows_per_metre, rows)
        reach = table.reach[row] if table.marks else ZERO
        lanes.depth[i] = d
        lanes.row[i] = row
        lanes.columns[i] = table.columns_per_metre[row]
        lanes.end[i] = -ONE if d <= ZERO else (d + reach if real else view.max_range)
        lanes.hit[i] = -1
        if d > ZERO:
            free_to = min(free_to, d - max(table.reach[row], half_cell) if real else view.max_range)
            if real:
                x, y, z = _point_cell(d, columns[i], ray, position)
                lanes.hit[i] = pack(x, y, z, lanes.hit)
    return free_to if free_to >= NO_RETURN else free_to - half_cell


@cell
def evidence(depth, measured, row, columns, look_up, width, weight):
    """Return the evidence at `depth` on a ray that measured `measured`, weighted if `weight` is above zero.

    look_up: the sensor table (rows * width,), negative and positive evidence together.
    """
    t = (depth - measured) * columns + np.float32(width) * HALF
    k = np.int32(min(max(t, ZERO), np.float32(width) - ONE))
    e = look_up[np.uint32(row * np.int32(width) + k)]
    return weighted(e, depth, weight)


@cell
def weighted(e, depth, weight):
    """Return evidence times min(1, weight depth^2) (Chien 2020, Eq 3.21) in 1/1024; as it is where weight is zero."""
    share = min(ONE, weight * depth * depth) * FRACTION
    return np.int32(np.floor(np.float32(e) * (share if weight > ZERO else ONE) + HALF))


@cell
def aim_at_hits(lanes, table, weight):
    """Make the measured points' cells the ones that are given evidence."""
    for i in range(lanes.depth.size):
        lanes.key[i] = lanes.hit[i]
        lanes.gain[i] = weighted(table.hit[lanes.row[i]], lanes.depth[i], weight) if lanes.hit[i] >= 0 else np.int32(0)


@cell
def give(lanes, weight, pool_table, coords, count, values):
    """Give each lane's gain to its cell; return False when the block pool is full.

    weight > 0: gains of one cell add up; else the strongest counts.
    """
    if weight > ZERO:  # two loops: a choice within the loop would take as long as the rest
        return _give(lanes, True, pool_table, coords, count, values)
    return _give(lanes, False, pool_table, coords, count, values)


@cell
def _give(lanes, adds, pool_table, coords, count, values):
    b = np.int64(bits(lanes.key))
    run, total, room = lanes.key[0], np.int32(0), True
    for i in range(lanes.key.size):
        if lanes.key[i] != run:
            room &= _enter(run, b, total, adds, pool_table, coords, count, values)  # leaving here would be slower
            run, total = lanes.key[i], np.int32(0)
        total = _joined(total, lanes.gain[i], adds)
    return room & _enter(run, b, total, adds, pool_table, coords, count, values)


@cell
def _joined(total, gain, adds):
    return np.int32(total + gain) if adds else stronger(total, gain)


@cell
def _enter(key, b, gain, adds, pool_table, coords, count, values):
    """Give evidence to the cell with this key of `b` bits an axis; return False when the block pool is full."""
    if gain == 0:
        return True
    x, y, z = unpack(key, b)
    place = find_or_insert(pool_table, coords, count, x >> 3, y >> 3, z >> 3)
    if place < 0:
        return False
    c = ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)
    values[place, c] = _joined(values[place, c], gain, adds)
    return True


@kernel
def merge(values, other, places, adds):
    """Add the blocks of `other` (n, 512) to `values` at `places`: sums, or the strongest."""
    for i in range(places.size):
        target = values[places[i]]
        for c in range(512):
            target[c] = target[c] + other[i, c] if adds else stronger(target[c], other[i, c])


@kernel
def to_thousandths(values, fraction_bits, out):
    """Round sums with `fraction_bits` to int16 thousandths."""
    half = np.int32((1 << fraction_bits) >> 1)
    for i in range(values.shape[0]):
        for c in range(512):
            out[i, c] = np.int16(min(max((values[i, c] + half) >> fraction_bits, -32767), 32767))
