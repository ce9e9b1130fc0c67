# SPDX-License-Identifier: Apache-2.0
"""Kernel of ray casting: every cell that a pixel's ray crosses (Amanatides and Woo 1987; Chien 2020, Alg 2)."""

import numpy as np

from stereovox._jit import cell, kernel
from stereovox.integrate._cells import HALF, NO_RETURN, ONE, ZERO, bits_of, float_of
from stereovox.integrate._hits import _row_rays
from stereovox.integrate._keys import pack
from stereovox.integrate._lanes import aim, aim_at_hits, evidence, give, weighted

BEYOND = np.float32(1e30)
TINY = np.float32(1e-30)


@kernel
def cast(depth_m, view, table, look_up, weight, lanes, pool_table, coords, count, values, first_row, last_row):
    """Add the evidence of all rays of rows first_row..last_row to an empty pool; return False when it is too small.

    depth_m: (h, w) REP 117 depth image. look_up: the sensor table (rows * columns,), both signs together.
    weight > 0: every ray adds its evidence to every cell it crosses, times min(1, weight * depth^2) (Chien 2020,
    Eq 3.21), in units of 1/1024 thousandths; 0: a cell keeps the strongest. Blocks count from the camera's own.
    """
    size = ONE / view.voxel_size
    position = view.position[0] * size, view.position[1] * size, view.position[2] * size
    together = lanes.depth.size
    for v in range(first_row, last_row):
        ray = _row_rays(view.forward, view.rows[v], size)
        for u in range(0, depth_m.shape[1], together):
            columns = view.columns[u : u + together]
            free_to = aim(depth_m[v, u : u + together], columns, ray, position, view, table, lanes)
            if free_to >= NO_RETURN:
                continue
            _start(columns, ray, position, lanes)
            reached, going = ZERO, True
            while going:
                if reached < free_to:  # plain free space needs no table
                    reached, going = _step(lanes, position, False, table, look_up, weight)
                else:
                    reached, going = _step(lanes, position, True, table, look_up, weight)
                if not give(lanes, weight, pool_table, coords, count, values):
                    return False
            aim_at_hits(lanes, table, weight)
            if not give(lanes, weight, pool_table, coords, count, values):
                return False
    return True


@cell
def _start(columns, ray, position, lanes):
    """Put all rays into the first cell they cross."""
    last = columns.size - 1
    for i in range(lanes.depth.size):
        column = columns[min(i, last)]
        dx, dy, dz = ray[0] * column + ray[1], ray[2] * column + ray[3], ray[4] * column + ray[5]
        lanes.entered[i] = ZERO
        lanes.x[i], lanes.y[i], lanes.z[i] = _first(position[0], dx), _first(position[1], dy), _first(position[2], dz)
        lanes.step_x[i], lanes.step_y[i], lanes.step_z[i] = _sign(dx), _sign(dy), _sign(dz)
        lanes.per_x[i], lanes.per_y[i], lanes.per_z[i] = _inverse(dx), _inverse(dy), _inverse(dz)


@cell
def _step(lanes, position, near, table, look_up, weight):
    """Take the evidence on every lane's cell and move to the next one.

    near: whether any ray may be near its measurement; else all of it is plain free space.
    Return the depth that the farthest ray has reached, and whether any goes on.
    """
    px, py, pz = position[0], position[1], position[2]
    width = table.clear.shape[1]
    reached = np.int32(0)  # the bits of a float that is not negative: those can be compared many at once
    for i in range(lanes.depth.size):
        x, y, z = lanes.x[i], lanes.y[i], lanes.z[i]
        sx, sy, sz = lanes.step_x[i], lanes.step_y[i], lanes.step_z[i]
        tx = (x + max(sx, ZERO) - px) * lanes.per_x[i]  # depth at which the ray leaves its cell along this axis
        ty = (y + max(sy, ZERO) - py) * lanes.per_y[i]
        tz = (z + max(sz, ZERO) - pz) * lanes.per_z[i]
        left = min(min(tx, ty), tz)
        entered, end = lanes.entered[i], lanes.end[i]
        key = pack(np.int32(x), np.int32(y), np.int32(z), lanes.key)
        middle = HALF * (entered + min(left, end))
        if near:
            e = evidence(middle, lanes.depth[i], lanes.row[i], lanes.columns[i], look_up, width, weight)
            counts = (entered <= end) & (key != lanes.hit[i])
        else:
            e = weighted(table.free, middle, weight)
            counts = entered <= end
        lanes.key[i] = key
        lanes.gain[i] = e if counts else np.int32(0)
        along_x = (tx <= ty) & (tx <= tz)
        along_y = (ty <= tz) & (not along_x)
        lanes.x[i] = x + (sx if along_x else ZERO)
        lanes.y[i] = y + (sy if along_y else ZERO)
        lanes.z[i] = z + (ZERO if along_x | along_y else sz)
        lanes.entered[i] = left if left < end else BEYOND
        reached = max(reached, bits_of(max(left, TINY) if left < end else ZERO))  # the first cell may end at depth zero
    return float_of(reached), reached > 0


@cell
def _first(start, direction):
    """Return the first cell along one axis: from a face on, a ray goes back into the cell before it."""
    return np.ceil(start) - ONE if direction < ZERO else np.floor(start)


@cell
def _inverse(direction):
    return ONE / direction if direction != ZERO else BEYOND


@cell
def _sign(direction):
    return ONE if direction >= ZERO else -ONE
