# SPDX-License-Identifier: Apache-2.0
"""Kernel of line drawing: one sample in each layer of cells along the ray's longest axis (Chien 2020, Alg 1).

Thinner than ray casting: a ray skips the cells it only grazes.
"""

import numpy as np

from stereovox._jit import cell, kernel
from stereovox.integrate._cells import NO_RETURN, ONE, ZERO, bits_of, float_of
from stereovox.integrate._hits import _row_rays
from stereovox.integrate._keys import pack
from stereovox.integrate._lanes import LANES, aim, aim_at_hits, evidence, give, mark_runs, passed, weighted

OFF_FACE = np.float32(1e-3)
"""Cells by which samples are kept off the faces of cells: on them, rounding would choose the cell."""


@kernel
def draw(depth_m, view, table, look_up, weight, lanes, memory, pool_table, coords, count, values, first_row, last_row):
    """Add the evidence of all lines of rows first_row..last_row to an empty pool; arguments as in `_ray.cast`."""
    size = ONE / view.voxel_size
    position = view.position[0] * size, view.position[1] * size, view.position[2] * size
    start = _off_faces(position[0]), _off_faces(position[1]), _off_faces(position[2])
    memory.block[:] = -1
    for v in range(first_row, last_row):
        ray = _row_rays(view.forward, view.rows[v], size)
        for u in range(0, depth_m.shape[1], LANES):
            columns = view.columns[u : u + LANES]
            n = columns.size
            free_to = aim(depth_m[v, u : u + n], columns, ray, position, view, table, lanes)
            if free_to >= NO_RETURN:
                continue
            _start(columns, ray, lanes)
            number, reached, going = ZERO, ZERO, True
            while going:
                plain = table.free if reached < free_to else np.int32(0)
                if reached < free_to:  # plain free space needs no table
                    reached, going = _step(n, lanes, number, start, False, table, look_up, weight)
                else:
                    reached, going = _step(n, lanes, number, start, True, table, look_up, weight)
                number += ONE
                runs, total = mark_runs(n, lanes)
                if not give(n, lanes, runs, total, plain, weight, memory, pool_table, coords, count, values):
                    return False
            runs, total = aim_at_hits(n, lanes, table, weight)
            if not give(n, lanes, runs, total, np.int32(0), weight, memory, pool_table, coords, count, values):
                return False
    return True


@cell
def _off_faces(place):
    """Return a camera's place on one axis, in cells, a little off the faces: its samples lie as it does."""
    cell_number = np.floor(place)
    return cell_number + min(max(place - cell_number, OFF_FACE), ONE - OFF_FACE)


@cell
def _start(columns, ray, lanes):
    """Set each ray's cells a metre of depth, and the depth that one cell along its longest axis takes."""
    for i in range(columns.size):
        column = columns[i]
        dx, dy, dz = ray[0] * column + ray[1], ray[2] * column + ray[3], ray[4] * column + ray[5]
        lanes.per_x[i], lanes.per_y[i], lanes.per_z[i] = dx, dy, dz
        lanes.entered[i] = ONE / max(max(abs(dx), abs(dy)), abs(dz))


@cell
def _step(n, lanes, number, start, near, table, look_up, weight):
    """Take the evidence on the cells at sample `number` of the first `n` lanes; see `_ray._step`."""
    px, py, pz = start
    width = table.clear.shape[1]
    reached = np.int32(0)  # the bits of a float that is not negative: those can be compared many at once
    for i in range(n):
        depth, end = number * lanes.entered[i], lanes.end[i]
        x = np.int32(np.floor(depth * lanes.per_x[i] + px))
        y = np.int32(np.floor(depth * lanes.per_y[i] + py))
        z = np.int32(np.floor(depth * lanes.per_z[i] + pz))
        key = pack(x, y, z, lanes.key)
        if near:
            e = evidence(depth, lanes.depth[i], lanes.row[i], lanes.columns[i], look_up, width, table, weight)
            counts = (depth <= end) & (key != lanes.hit[i])
        else:
            e = weighted(passed(table, depth), depth, weight)
            counts = depth <= end
        lanes.key[i] = key
        lanes.gain[i] = e if counts else np.int32(0)
        following = depth + lanes.entered[i]
        reached = max(reached, bits_of(following if following <= end else ZERO))
    return float_of(reached), reached > 0
