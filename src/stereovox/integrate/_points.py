# SPDX-License-Identifier: Apache-2.0
"""Kernel of rays that end at single points: ray casting (Amanatides and Woo 1987) with a direction for each lane."""

import numpy as np

from stereovox.integrate._cells import NO_RETURN, ONE, ZERO, bits_of, float_of, pack, table_row
from stereovox.integrate._lanes import HALF_DIAGONAL, LANES, _sign, even_to
from stereovox.integrate._ray import _inverse, first_cell, walk
from stereovox.kernels._jit import cell, kernel
from stereovox.kernels._math import floor


@kernel
def cast(rays, runs, places, view, table, look_up, lanes, memory, pool_table, coords, count, values, first, step):
    """Add the evidence of rays to an empty pool, the strongest in each cell; return False if it is too small.

    rays: (5, N) direction in cells per metre, metres to the surface (NO_RETURN: none), metres to the end of a ray
    without one. runs: (K, 3) first ray, end, and place of runs with one place and the same signs along the axes.
    places: (P, 3) in cells from the corner of the origin block. first, step: every `step`-th run.
    """
    memory.block[:] = -1
    even = even_to(table, view)
    for k in range(first, runs.shape[0], step):
        start, stop, p = runs[k, 0], runs[k, 1], runs[k, 2]
        position = places[p, 0], places[p, 1], places[p, 2]
        signs = _sign(rays[0, start]), _sign(rays[1, start]), _sign(rays[2, start])
        free_to = _aim(rays[:, start:stop], position, signs, view, table, lanes)
        if free_to >= NO_RETURN:
            continue
        if not walk(
            lanes, position, signs, min(free_to, even), table, look_up, None, memory, pool_table, coords, count, values
        ):
            return False
    return True


@kernel
def lay(ends, hits, of_place, places, R, t, cell, max_range, reach, rays, course):
    """Write the rays of a cloud as `cast` takes them; return how many carry evidence.

    ends (N, 3): in metres along the sensor's axes; R (3, 3), t (3,): from there into the axes of places (P, 3), which
    are in cells. hits (N,): whether at a surface. of_place (N,): the place where each begins; (0,): all at the first.
    reach: metres before a surface up to which a ray beyond the range is free. Written: rays (5, N); course (N,): signs
    along the axes, and the place.
    """
    used = 0
    for i in range(ends.shape[0]):
        p = of_place[i] if of_place.shape[0] else 0
        x, y, z = ends[i, 0], ends[i, 1], ends[i, 2]
        dx = (R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]) / cell[0] - places[p, 0]
        dy = (R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]) / cell[1] - places[p, 1]
        dz = (R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]) / cell[2] - places[p, 2]
        length = np.sqrt((dx * cell[0]) ** 2 + (dy * cell[1]) ** 2 + (dz * cell[2]) ** 2)
        seen = hits[i] and length <= max_range
        clear = min(max(length - reach if hits[i] else length, 0.0), max_range)
        if not (length > 0 and (seen or clear > 0)):
            continue
        rays[0, used], rays[1, used], rays[2, used] = dx / length, dy / length, dz / length
        rays[3, used], rays[4, used] = length if seen else NO_RETURN, clear
        course[used] = 8 * p + 4 * (dx >= 0) + 2 * (dy >= 0) + (dz >= 0)
        used += 1
    return used


@cell
def _aim(rays, position, signs, view, table, lanes):
    """Fill the lanes for a run of rays, in the first cell they cross; spare lanes copy the last ray, and end at once.

    Return the depth up to which cells may begin that are plainly free for all lanes; NO_RETURN without any ray.
    """
    key, x, y, z = first_cell(position, signs, lanes.cell)
    half_cell, nearest = HALF_DIAGONAL * view.voxel_size, bits_of(NO_RETURN)
    n = rays.shape[1]
    for i in range(LANES):
        j = min(i, n - 1)
        dx, dy, dz, d, clear = rays[0, j], rays[1, j], rays[2, j], rays[3, j], rays[4, j]
        real = d < NO_RETURN
        row = table_row(min(d, view.max_range), table.rows_per_metre, table.hit.size)
        reach = table.reach[row]
        end = (d + (reach if table.marks else ZERO)) if real else clear
        lanes.depth[i], lanes.row[i], lanes.end[i] = d, row, end if i < n else -ONE
        lanes.columns[i], lanes.reach[i] = table.columns_per_metre[row], reach
        lanes.entered[i], lanes.cell[i] = ZERO, key
        lanes.x[i], lanes.y[i], lanes.z[i] = x, y, z
        lanes.per_x[i], lanes.per_y[i], lanes.per_z[i] = _inverse(dx), _inverse(dy), _inverse(dz)
        point = d if real else ZERO
        hit = pack(
            np.int32(floor(position[0] + point * dx)),
            np.int32(floor(position[1] + point * dy)),
            np.int32(floor(position[2] + point * dz)),
            lanes.hit,
        )
        lanes.hit[i] = hit if real & (i < n) else lanes.hit.dtype.type(-1)
        plain = (d - max(reach, half_cell)) if real else clear
        nearest = min(nearest, bits_of(max(plain, ZERO) if i < n else NO_RETURN))
    free_to = float_of(nearest)
    return free_to if free_to >= NO_RETURN else free_to - half_cell
