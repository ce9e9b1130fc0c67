# SPDX-License-Identifier: Apache-2.0
"""Kernel functions shared by ray casting and line drawing: many rays in step, and the evidence they give to cells.

A step first finds, for all lanes, the key of the present cell and its evidence (`key`, `gain`): plain arithmetic, which
the compiler vectorises over lanes. Then gains are summed in runs, since neighbouring rays mostly cross the same cell.
"""

import numpy as np

from stereovox.integrate._cells import (
    HALF,
    NO_RETURN,
    ONE,
    ZERO,
    bits,
    bits_of,
    float_of,
    pack,
    stronger,
    table_row,
    unpack,
    usable,
)
from stereovox.integrate._hits import _point_cell
from stereovox.kernels._jit import cell, kernel
from stereovox.maps.cells._cells import find_or_insert

LANES = 32
"""Neighbouring pixels of a row that are walked in step."""
GROUP_BITS = 3
"""Binary logarithm of the number of lanes whose gains are summed sequentially."""
MEMORY_BITS = 9
"""Binary logarithm of the number of blocks cached in front of the pool's hash: 8 along each axis."""
NOWHERE = np.float32(-1e30)
"""Stands for the depth of a cell to which a lane gives no evidence."""
FRACTION_BITS = 10
"""Weighted evidence is summed in units of 2^-10 thousandths: integers, so the order of rays does not matter."""
FRACTION = np.float32(1 << FRACTION_BITS)
HALF_DIAGONAL = np.float32(0.8661)
"""Largest depth, in cells, from a ray's entry into a cell to the middle of its path through it."""


@cell
def in_step(columns, ray):
    """Return how many of the columns' rays agree in direction along each axis, and the signs along x, y and z."""
    signs = _signs(ray, columns[0])
    n = columns.size
    while _signs(ray, columns[n - 1]) != signs:  # directions change evenly from column to column
        n -= 1
    return n, signs


@cell
def _signs(ray, column):
    return _sign(ray[0] * column + ray[1]), _sign(ray[2] * column + ray[3]), _sign(ray[4] * column + ray[5])


@cell
def _sign(direction):
    return ONE if direction >= ZERO else -ONE


@cell
def even_to(table, view):
    """Return the depth up to which cells may begin whose passed loss is certainly `table.free`."""
    row = 0
    while row < table.passed.size and table.passed[row] == table.free:
        row += 1
    ends = NO_RETURN if row == table.passed.size else np.float32(np.int32(row - 1)) / table.rows_per_metre
    return ends - HALF_DIAGONAL * view.voxel_size


@cell
def aim(depths, columns, ray, position, view, table, lanes):
    """Fill column, depth, end, row, columns and hit of the lanes for a run of pixels.

    Return the depth up to which cells may begin that are plainly free for all lanes; NO_RETURN without any ray.

    depths, columns: REP 117 depth and x/z of at most LANES pixels of one image row. ray: see `_row_rays`.
    """
    _take(depths, columns, view, table, lanes)
    for i in range(LANES):
        row = np.uint32(lanes.row[i])
        lanes.columns[i], lanes.reach[i] = table.columns_per_metre[row], table.reach[row]
    nearest = bits_of(NO_RETURN)  # integers, whose comparisons vectorise
    half_cell = HALF_DIAGONAL * view.voxel_size  # the cell of the measured point is never "plainly free"
    for i in range(LANES):
        d, reach = lanes.depth[i], lanes.reach[i]
        real = d < NO_RETURN
        end = (d + (reach if table.marks else ZERO)) if real else view.max_range
        lanes.end[i] = end if d > ZERO else -ONE
        plain = (d - max(reach, half_cell)) if real else view.max_range
        nearest = min(nearest, bits_of(max(plain, ZERO) if d > ZERO else NO_RETURN))
        x, y, z = _point_cell(d if real else ZERO, lanes.column[i], ray, position)
        key = pack(x, y, z, lanes.hit)
        lanes.hit[i] = key if (d > ZERO) & real else lanes.hit.dtype.type(-1)
    free_to = float_of(nearest)
    return free_to if free_to >= NO_RETURN else free_to - half_cell


@cell
def _take(depths, columns, view, table, lanes):
    """Fill depth, row and column of the lanes. Spare lanes copy the last pixel, and end at once."""
    n = depths.size
    for i in range(n):
        d = usable(depths[i])
        row = table_row(min(d, view.max_range), table.rows_per_metre, table.hit.size)
        lanes.depth[i], lanes.row[i], lanes.column[i] = d, row, columns[i]
    for i in range(n, LANES):
        lanes.depth[i], lanes.row[i], lanes.column[i] = ZERO, np.int32(0), columns[n - 1]


@cell
def free_space(lanes, table, weight):
    """Set the evidence of all lanes, none of them near its measurement or where `table.passed` changes.

    Return its sum, and, if `weight` is None, as bits which lanes differ in evidence from the previous one.
    """
    total, unlike, before = np.int32(0), np.int32(0), table.free
    for i in range(LANES):
        middle = lanes.middle[i]
        gain = weighted(table.free if middle > table.blind else np.int32(0), middle, weight)
        lanes.gain[i] = gain
        total = np.int32(total + gain)
        if weight is None:
            unlike = np.int32(unlike | bit_if(gain != before, lanes.bit[i]))
            before = gain
    return total, unlike


@cell
def evidence(lanes, look_up, table, weight):
    """Set the evidence of all lanes at `middle`, weighted unless `weight` is None; return as `free_space` does.

    look_up: the sensor table (rows * width,), negative and positive evidence together. Table indices first, then the
    loads, then arithmetic: most processors cannot vectorise all three at once.
    """
    width = np.int32(table.clear.shape[1])
    half, last_column = np.float32(width) * HALF, np.float32(width) - ONE
    last_row = np.float32(np.int32(table.passed.size - 1))
    for i in range(LANES):
        middle = lanes.middle[i]
        t = (middle - lanes.depth[i]) * lanes.columns[i] + half
        k = np.int32(min(max(t, ZERO), last_column))
        lanes.place[i] = np.int32(lanes.row[i] * width + k)
        lanes.passed[i] = np.int32(min(max(middle * table.rows_per_metre, ZERO), last_row))
    for i in range(LANES):
        lanes.place[i] = look_up[np.uint32(lanes.place[i])]
        lanes.passed[i] = table.passed[np.uint32(lanes.passed[i])]
    total, unlike, before = np.int32(0), np.int32(0), table.free
    for i in range(LANES):
        middle = lanes.middle[i]
        e = max(lanes.place[i], lanes.passed[i] if middle > table.blind else np.int32(0))
        e = e if middle >= ZERO else np.int32(0)  # a table may mark from its first column on
        gain = weighted(e, middle, weight)
        lanes.gain[i] = gain
        total = np.int32(total + gain)
        if weight is None:
            unlike = np.int32(unlike | bit_if(gain != before, lanes.bit[i]))
            before = gain
    return total, unlike


@cell
def weighted(e, depth, weight):
    """Return evidence times min(1, weight depth^2) (Chien 2020, Eq 3.21) in 1/1024; unchanged if weight is None."""
    if weight is None:
        return e
    share = min(ONE, weight * depth * depth) * FRACTION
    return np.int32(np.floor(np.float32(e) * share + HALF))


@cell
def aim_at_hits(lanes, table, weight):
    """Select the cells of measured points for `give`; return its starts and total."""
    for i in range(LANES):
        lanes.gain[i] = table.hit[np.uint32(lanes.row[i])]
    total, starts, before, other = np.int32(0), np.int32(0), lanes.hit[0], np.int32(0)
    for i in range(LANES):
        hit = lanes.hit[i]
        gain = weighted(lanes.gain[i], lanes.depth[i], weight) if hit >= 0 else np.int32(0)
        lanes.key[i], lanes.gain[i] = hit, gain
        total = np.int32(total + gain)
        starts = np.int32(starts | bit_if((hit != before) | (gain != other), lanes.bit[i]))
        before, other = hit, gain
    return starts, total


@cell
def bit_if(differs, bit):
    """Return `bit` if `differs`, else 0; without a branch, which some processors cannot vectorise."""
    return np.int32(bit & np.int32(-np.int32(differs)))


@cell
def give(lanes, starts, total, weight, memory, pool_table, coords, count, values):
    """Give the gains of all lanes to their cells; return False if the block pool is full.

    starts: bits of the lanes whose cell differs from the previous one; the first bit is ignored. total: of all gains.
    weight: gains of one cell add up; None: the strongest counts, and a different gain starts a run too.
    """
    b = np.int64(bits(lanes.key))
    rest = np.int64(starts) & np.int64(0xFFFFFFFE)
    if weight is not None and rest != 0:
        _add_up(lanes)
    room, at, before = True, np.uint32(0), np.int32(0)
    while rest != 0:
        low = rest & -rest
        rest ^= low
        following = np.uint32((bits_of(np.float32(low)) >> np.int32(23)) - np.int32(127))  # the exponent: its index
        if weight is None:
            gain = lanes.gain[at]
        else:
            sums = np.int32(lanes.within[following] + lanes.groups[following >> np.uint32(GROUP_BITS)])
            gain = np.int32(sums - before)
            before = sums
        room &= _enter(lanes.key[at], b, gain, weight, memory, pool_table, coords, count, values)
        at = following
    gain = lanes.gain[at] if weight is None else np.int32(total - before)
    return _enter(lanes.key[at], b, gain, weight, memory, pool_table, coords, count, values) & room


@cell
def _add_up(lanes):
    """Sum the gains of all lanes before each one: `within` its group, and over earlier `groups`."""
    total = np.int32(0)
    for g in range(LANES >> GROUP_BITS):  # short chains, which the processor runs in parallel
        lanes.groups[g], within = total, np.int32(0)
        for i in range(g << GROUP_BITS, (g + 1) << GROUP_BITS):
            lanes.within[i] = within
            within = np.int32(within + lanes.gain[i])
        total = np.int32(total + within)


@cell
def _enter(key, b, gain, weight, memory, pool_table, coords, count, values):
    """Give evidence to the cell with this key of `b` bits per axis; return False if the block pool is full."""
    if gain == 0:
        return True
    x, y, z = unpack(key, b)
    block = np.int64(key) & ~np.int64((7 << (b + b)) | (7 << b) | 7)
    slot = ((x & 56) << 3) | (y & 56) | ((z & 56) >> 3)
    if memory.block[slot] != block:
        memory.place[slot] = find_or_insert(pool_table, coords, count, x >> 3, y >> 3, z >> 3)
        memory.block[slot] = block
    place = memory.place[slot]
    if place < 0:
        return False
    c = ((x & 7) << 6) | ((y & 7) << 3) | (z & 7)
    old = values[place, c]
    values[place, c] = stronger(old, gain) if weight is None else np.int32(old + gain)
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
