# SPDX-License-Identifier: Apache-2.0
"""Kernel that evaluates every cell of the blocks that culling could not decide, in rows the compiler vectorises.

Nearly all cells are plain: free, for they lie well before what was measured, or behind it. So a layer of cells is first
told apart by two comparisons, and only a layer with cells near a measurement is looked up in the sensor table.
"""

import numpy as np

from stereovox._jit import cell, kernel
from stereovox.integrate._cells import HALF, NEAR_PLANE, NO_RETURN, ONE, ZERO, index, table_row, window_level
from stereovox.integrate._windows import COARSEST, place

LAYER = 64
"""Cells told apart together: one layer of a block."""
UNSEEN = np.float32(-1e9)
"""Depth that stands for "nothing was measured where this cell is": every cell lies behind it."""


@kernel
def evaluate(depth_m, view, table, windows, blocks, hit_of, hit_values, values, depths, measured):
    """Fill `values` (n, 512) int16 with the evidence on the cells of `blocks` (n, 3), hits included.

    depth_m: (h, w) REP 117 depth image, from which `windows` was made. hit_of: (n,) place of each block among the hits,
    -1 for none. depths, measured: (LAYER,) float32 scratch.
    """
    side = np.float32(8) * view.voxel_size
    for i in range(blocks.shape[0]):
        x, y, z = blocks[i, 0], blocks[i, 1], blocks[i, 2]
        px = np.float32(x) * side - view.position[0]
        py = np.float32(y) * side - view.position[1]
        pz = np.float32(z) * side - view.position[2]
        R = view.rotation
        cx = (R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz) * view.intrinsics[0]
        cy = (R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz) * view.intrinsics[1]
        cz = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        out = values[i]
        _clear(view, table, windows, cx, cy, cz, _passed(view, table, cz), depths, measured, out)
        if table.marks:
            _mark(depth_m, view, table, cx, cy, cz, out)
        if hit_of[i] >= 0:
            hits = hit_values[hit_of[i]]
            for c in range(512):
                out[c] = max(out[c], hits[c]) if hits[c] > 0 else out[c]


@kernel
def passed(view, table, blocks, out):
    """Fill `out` (n,) int16 with the evidence on all cells of each of `blocks` (n, 3), which are wholly free."""
    side = np.float32(8) * view.voxel_size
    R = view.rotation
    for i in range(blocks.shape[0]):
        px = np.float32(blocks[i, 0]) * side - view.position[0]
        py = np.float32(blocks[i, 1]) * side - view.position[1]
        pz = np.float32(blocks[i, 2]) * side - view.position[2]
        out[i] = np.int16(_passed(view, table, R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz))


@cell
def _passed(view, table, cz):
    """Return the most that the cells of a block lose when they are looked through, by the depth of its centre.

    cz: depth of the block's corner.
    """
    R = view.rotation
    z = cz + np.float32(4) * view.voxel_size * (R[2, 0] + R[2, 1] + R[2, 2])
    return table.passed[table_row(min(max(z, ZERO), view.max_range), table.rows_per_metre, table.passed.size)]


@cell
def _clear(view, table, windows, cx, cy, cz, most, depths, measured, out):
    """Write the negative evidence: what the farthest pixel in a window about the cell's size says, `most` at most.

    depths, measured: (LAYER,) scratch.
    """
    R = view.rotation
    farther = max(R[2, 0], ZERO) + max(R[2, 1], ZERO) + max(R[2, 2], ZERO)
    z_most = max(cz + np.float32(8) * view.voxel_size * farther, ZERO)
    before = table.before[table_row(min(z_most, view.max_range), table.rows_per_metre, table.before.size)]
    for layer in range(0, 512, LAYER):
        cells = slice(layer, layer + LAYER)
        steps = view.steps[0, cells], view.steps[1, cells], view.steps[2, cells]
        _measure(view, windows, max(NEAR_PLANE, table.blind), cx, cy, cz, steps, depths, measured)
        if _tell_apart(depths, measured, before, table.behind, most, out[cells]):
            _look_up(view, table, depths, measured, most, out[cells])


@cell
def _measure(view, windows, nearest, cx, cy, cz, steps, depths, measured):
    """Fill `depths` with the depth of each cell's centre and `measured` with what was measured there.

    nearest: depth up to which cells are not looked at.
    """
    fx_steps, fy_steps, z_steps = steps
    u_centre, v_centre = view.intrinsics[2] + HALF, view.intrinsics[3] + HALF
    right, bottom = np.float32(view.width - 1), np.float32(view.height - 1)
    u_end, v_end = np.float32(view.width), np.float32(view.height)
    first, last = np.int32(windows.first), np.int32(COARSEST)
    for c in range(LAYER):
        z = cz + z_steps[c]
        ahead = (z > nearest) & (z <= view.max_range)
        inverse = ONE / (z if ahead else ONE)
        u = (cx + fx_steps[c]) * inverse + u_centre
        v = (cy + fy_steps[c]) * inverse + v_centre
        u_rim, v_rim = view.rim[0] * inverse, view.rim[1] * inverse
        seen = ahead & (u >= -u_rim) & (v >= -v_rim) & (u < u_end + u_rim) & (v < v_end + v_rim)
        level = min(max(window_level(view.spread * inverse), first), last)
        i = place(level, min(max(v, ZERO), bottom), min(max(u, ZERO), right), windows.pitch, windows.height)
        d = windows.image[index(i)]
        depths[c] = z
        measured[c] = d if seen else UNSEEN


@cell
def _tell_apart(depths, measured, before, behind, free, out):
    """Write `free` for cells wholly before their measurement, else 0; return whether any lies near it."""
    near = np.int32(0)
    for c in range(LAYER):
        ahead = measured[c] - depths[c]
        out[c] = np.int16(free if ahead > before else np.int32(0))
        near |= np.int32((ahead <= before) & (ahead >= -behind) & (measured[c] > ZERO))
    return near != 0


@cell
def _look_up(view, table, depths, measured, most, out):
    """Write what the sensor table says of cells that are not wholly before their measurement, `most` at most."""
    last_row = np.int32(table.hit.size - 1)
    columns, clear = np.int32(table.clear.shape[1]), table.clear.reshape(table.clear.size)
    last_column, middle_column = np.float32(columns - 1), np.float32(columns) * HALF
    for c in range(LAYER):
        d = measured[c]
        row = min(np.int32(min(max(d, ZERO), view.max_range) * table.rows_per_metre), last_row)
        t = (depths[c] - d) * table.columns_per_metre[index(row)] + middle_column
        k = np.int32(min(max(t, ZERO), last_column))
        e = max(clear[index(np.int32(np.int32(row * columns) + k))], most)
        out[c] = np.int16(e if d > ZERO else np.int32(0))


@cell
def _mark(depth_m, view, table, cx, cy, cz, out):
    """Overwrite with the positive evidence, where there is any, of the pixel at the cell's centre."""
    u_centre, v_centre = view.intrinsics[2] + HALF, view.intrinsics[3] + HALF
    rows = table.hit.size
    last_column, middle_column = np.float32(table.mark.shape[1] - 1), np.float32(table.mark.shape[1]) * HALF
    for c in range(512):
        z = cz + view.steps[2, c]
        if z <= NEAR_PLANE or z > view.max_range:
            continue
        u = (cx + view.steps[0, c]) / z + u_centre
        v = (cy + view.steps[1, c]) / z + v_centre
        if not (u >= ZERO and v >= ZERO and u < np.float32(view.width) and v < np.float32(view.height)):
            continue
        d = depth_m[np.int32(v), np.int32(u)]
        if not (d > ZERO and d < NO_RETURN):
            continue
        row = table_row(d, table.rows_per_metre, rows)
        t = (z - d) * table.columns_per_metre[row] + middle_column
        if t < ZERO or t > last_column:
            continue
        e = table.mark[row, np.int32(t)]
        if e > 0:
            out[c] = np.int16(e)
