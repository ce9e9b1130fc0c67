# SPDX-License-Identifier: Apache-2.0
"""Kernels of ray casting (`cast`, Amanatides and Woo 1987) and of line drawing (`draw`, Chien 2020, 3.4).

Line drawing takes one sample in each layer of cells along the ray's longest axis (Chien 2020, Alg 1); it skips cells
that a ray only grazes.
"""

import numpy as np

from stereovox.integrate._cells import HALF, NO_RETURN, ONE, ZERO, bits_of, float_of, pack, strides
from stereovox.integrate._hits import _row_rays
from stereovox.integrate._lanes import (
    LANES,
    NOWHERE,
    aim,
    aim_at_hits,
    bit_if,
    even_to,
    evidence,
    free_space,
    give,
    in_step,
)
from stereovox.kernels._jit import cell, kernel

OFF_FACE = np.float32(1e-3)
"""Distance in cells that samples keep from the faces of cells, at which rounding would choose the cell."""
BEYOND = np.float32(1e30)
"""Stands for infinity: depth of the next face along an axis on which a ray does not advance."""
TINY = np.float32(1e-30)


@kernel
def cast(depth_m, view, table, look_up, weight, lanes, memory, pool_table, coords, count, values, first, stop, step):
    """Add the evidence of all rays of some rows to an empty pool; return False if it is too small.

    depth_m: (h, w) REP 117 depth image. look_up: the sensor table (rows * columns,), both signs together.
    weight: every ray adds its evidence to every cell it crosses, times min(1, weight * depth^2) (Chien 2020, Eq 3.21),
    in units of 1/1024 thousandths; None: a cell keeps the strongest. Block coordinates count from the camera's block.
    first, stop, step: every `step`-th row from `first` to before `stop`.
    """
    size = ONE / view.voxel_size
    position = view.position[0] * size, view.position[1] * size, view.position[2] * size
    memory.block[:] = -1
    even = even_to(table, view)
    for v in range(first, stop, step):
        ray, u = _row_rays(view.forward, view.rows[v], size), 0
        while u < depth_m.shape[1]:
            n, signs = in_step(view.columns[u : u + LANES], ray)
            free_to = aim(depth_m[v, u : u + n], view.columns[u : u + n], ray, position, view, table, lanes)
            u += n
            if free_to >= NO_RETURN:
                continue
            _start(ray, position, signs, lanes)
            if not walk(
                lanes, position, signs, min(free_to, even), table, look_up, weight,
                memory, pool_table, coords, count, values,
            ):  # fmt: skip
                return False
    return True


@cell
def walk(
    lanes, position, signs, tableless_to, table, look_up, weight, memory, pool_table, coords, count, values
):  # fmt: skip
    """Follow all rays from their first cells to their ends, then give their hits; return False if the pool is full.

    tableless_to: depth up to which cells may begin that do not need the sensor table.
    """
    reached, going = ZERO, True
    while going:
        tableless = reached < tableless_to
        reached, going, starts = _step(lanes, position, signs)
        if tableless:
            total, unlike = free_space(lanes, table, weight)
        else:
            total, unlike = evidence(lanes, look_up, table, weight)
        if not give(lanes, starts | unlike, total, weight, memory, pool_table, coords, count, values):
            return False
    starts, total = aim_at_hits(lanes, table, weight)
    return give(lanes, starts, total, weight, memory, pool_table, coords, count, values)


@cell
def first_cell(position, signs, keys):
    """Return the key of the first cell that rays with these signs cross, and the faces through which they leave it."""
    x, y, z = _first(position[0], signs[0]), _first(position[1], signs[1]), _first(position[2], signs[2])
    key = pack(np.int32(x), np.int32(y), np.int32(z), keys)
    return key, x + max(signs[0], ZERO), y + max(signs[1], ZERO), z + max(signs[2], ZERO)


@cell
def _start(ray, position, signs, lanes):
    """Put all rays into the first cell they cross."""
    key, x, y, z = first_cell(position, signs, lanes.cell)
    for i in range(LANES):
        column = lanes.column[i]
        lanes.entered[i], lanes.cell[i] = ZERO, key
        lanes.x[i], lanes.y[i], lanes.z[i] = x, y, z
        lanes.per_x[i] = _inverse(ray[0] * column + ray[1])
        lanes.per_y[i] = _inverse(ray[2] * column + ray[3])
        lanes.per_z[i] = _inverse(ray[4] * column + ray[5])


@cell
def _step(lanes, position, signs):
    """Fill key and middle of the lanes for their present cells, and move to the next ones.

    Return the depth that the farthest ray has reached, whether any ray continues, and the starts for `give`.
    """
    px, py, pz = position
    sx, sy, sz = signs
    by_x, by_y, by_z = strides(signs, lanes.cell)
    starts, before = np.int32(0), lanes.cell[0]
    reached = np.int32(0)  # the bits of a non-negative float: integer comparisons vectorise
    for i in range(LANES):
        x, y, z = lanes.x[i], lanes.y[i], lanes.z[i]
        tx = (x - px) * lanes.per_x[i]  # depth at which the ray leaves its cell along this axis
        ty = (y - py) * lanes.per_y[i]
        tz = (z - pz) * lanes.per_z[i]
        left = min(min(tx, ty), tz)
        entered, end = lanes.entered[i], lanes.end[i]
        key = lanes.cell[i]
        lanes.key[i] = key
        starts = np.int32(starts | bit_if(key != before, lanes.bit[i]))
        before = key
        lanes.middle[i] = HALF * (entered + min(left, end)) if (entered <= end) & (key != lanes.hit[i]) else NOWHERE
        along_x = tx <= left
        along_y = (ty <= left) & (not along_x)
        lanes.x[i] = x + (sx if along_x else ZERO)
        lanes.y[i] = y + (sy if along_y else ZERO)
        lanes.z[i] = z + (ZERO if along_x | along_y else sz)
        by_yz = by_y if along_y else by_z
        lanes.cell[i] = key + (by_x if along_x else by_yz)
        lanes.entered[i] = left if left < end else BEYOND
        reached = max(reached, bits_of(max(left, TINY) if left < end else ZERO))  # the first cell may end at depth zero
    return float_of(reached), reached > 0, starts


@cell
def _first(start, sign):
    """Return the first cell along one axis: from a face, a backward ray enters the cell before it."""
    return np.ceil(start) - ONE if sign < ZERO else np.floor(start)


@cell
def _inverse(direction):
    return ONE / direction if direction != ZERO else BEYOND


@kernel
def draw(depth_m, view, table, look_up, weight, lanes, memory, pool_table, coords, count, values, first, stop, step):
    """Add the evidence of all lines of some rows to an empty pool; arguments as in `cast`."""
    size = ONE / view.voxel_size
    position = view.position[0] * size, view.position[1] * size, view.position[2] * size
    start = _off_faces(position[0]), _off_faces(position[1]), _off_faces(position[2])
    memory.block[:] = -1
    even = even_to(table, view)
    for v in range(first, stop, step):
        ray = _row_rays(view.forward, view.rows[v], size)
        for u in range(0, depth_m.shape[1], LANES):
            columns = view.columns[u : u + LANES]
            free_to = aim(depth_m[v, u : u + LANES], columns, ray, position, view, table, lanes)
            if free_to >= NO_RETURN:
                continue
            _line_start(ray, lanes)
            number, reached, going = ZERO, ZERO, True
            while going:
                tableless = reached < min(free_to, even)
                reached, going, starts = _line_step(lanes, number, start)
                if tableless:
                    total, unlike = free_space(lanes, table, weight)
                else:
                    total, unlike = evidence(lanes, look_up, table, weight)
                number += ONE
                if not give(lanes, starts | unlike, total, weight, memory, pool_table, coords, count, values):
                    return False
            starts, total = aim_at_hits(lanes, table, weight)
            if not give(lanes, starts, total, weight, memory, pool_table, coords, count, values):
                return False
    return True


@cell
def _off_faces(place):
    """Return a camera's coordinate on one axis, in cells, moved a little off the faces, and so its samples."""
    cell_number = np.floor(place)
    return cell_number + min(max(place - cell_number, OFF_FACE), ONE - OFF_FACE)


@cell
def _line_start(ray, lanes):
    """Set each ray's cells per metre of depth, and the depth of one cell along its longest axis."""
    for i in range(LANES):
        column = lanes.column[i]
        dx, dy, dz = ray[0] * column + ray[1], ray[2] * column + ray[3], ray[4] * column + ray[5]
        lanes.per_x[i], lanes.per_y[i], lanes.per_z[i] = dx, dy, dz
        lanes.entered[i] = ONE / max(max(abs(dx), abs(dy)), abs(dz))


@cell
def _line_step(lanes, number, start):
    """Fill key and middle of the lanes at sample `number`.

    Return the depth of the farthest ray's next sample, whether there is one, and the starts for `give`.
    """
    px, py, pz = start
    starts, before = np.int32(0), lanes.key.dtype.type(-1)
    reached = np.int32(0)  # the bits of a non-negative float: integer comparisons vectorise
    for i in range(LANES):
        depth, end = number * lanes.entered[i], lanes.end[i]
        x = np.int32(np.floor(depth * lanes.per_x[i] + px))
        y = np.int32(np.floor(depth * lanes.per_y[i] + py))
        z = np.int32(np.floor(depth * lanes.per_z[i] + pz))
        key = pack(x, y, z, lanes.key)
        lanes.key[i] = key
        starts = np.int32(starts | bit_if(key != before, lanes.bit[i]))
        before = key
        lanes.middle[i] = depth if (depth <= end) & (key != lanes.hit[i]) else NOWHERE
        following = depth + lanes.entered[i]
        reached = max(reached, bits_of(following if following <= end else ZERO))
    return float_of(reached), reached > 0, starts
