# SPDX-License-Identifier: Apache-2.0
"""Kernels of the projective integrator: cull blocks from coarse to fine, and evaluate each cell of the rest.

Nearly all cells are plain: either free, well before the measurement, or behind it. So a layer of cells is first
classified by two comparisons, and only a layer with cells near a measurement is looked up in the sensor table.
"""

import numpy as np

from stereovox.integrate._cells import HALF, NEAR_PLANE, NO_RETURN, ONE, ZERO, index, table_row, window_level
from stereovox.integrate._windows import COARSEST, build, clear_to, nearest_tiles, place
from stereovox.kernels._jit import cell, kernel
from stereovox.kernels._math import floor
from stereovox.maps.cells._cells import find

SKIP, FREE, MIXED = 0, 1, 2
"""Kinds of boxes; see `_classify`."""
SLACK = np.float32(1e-3)
"""Pixels, and share of a depth, by which boxes are enlarged: culling may err only on the safe side."""
COARSE = 4
"""Blocks along each side of a coarse box; the level between it and a block has boxes of two blocks."""
TEN = np.float32(10)
STACK = 32
"""Most boxes on the stack: eight of each of two sizes."""
LAYER = 64
"""Cells classified together: one layer of a block."""
UNSEEN = np.float32(-1e9)
"""Depth that stands for "no measurement at this cell": every cell is behind it."""


@kernel
def survey(depth_m, ends, view, table, windows, scratch, nearest, stack, free, mixed):
    """Build the window images, and list the blocks that are wholly free and those to evaluate cell by cell.

    Return both numbers; -1 if a list is too short.

    depth_m: (h, w) REP 117 depth image. ends: the same, but for pixels that see nothing, the depth up to which they see
    nothing. windows, scratch, nearest: `Windows`, `WindowScratch` and tiles, written. stack: (STACK, 4) int32 scratch.
    free, mixed: (capacity, 3) int32, written: block coordinates from the camera's block.
    """
    farthest = build(ends.reshape(ends.size), windows, table, scratch)
    if table.marks:
        nearest_tiles(depth_m, nearest[0], nearest[1])
        farthest = view.max_range  # a lone pixel, which clears nothing, marks cells next to its point
    return _candidates(view, table, windows, nearest, _end_of_view(view, table, farthest), stack, free, mixed)


@cell
def _end_of_view(view, table, farthest):
    """Return the depth in metres beyond which an image whose farthest depth is `farthest` gives no evidence."""
    if farthest >= NO_RETURN:
        return view.max_range
    behind = table.reach[table.reach.size - 1] if table.marks else table.behind
    return min(view.max_range, max(farthest, TEN * NEAR_PLANE) * (ONE + SLACK) + behind)


@cell
def _candidates(view, table, windows, nearest, end, stack, free, mixed):
    """List the blocks that are wholly free and those to evaluate; see `survey`.

    end: depth in metres beyond which the image gives no evidence.
    """
    n_free, n_mixed = 0, 0
    low_x, high_x = _touched(view, end, np.int64(0))  # all of one type: each literal would compile it again
    low_y, high_y = _touched(view, end, np.int64(1))
    low_z, high_z = _touched(view, end, np.int64(2))
    for bx in range(low_x, high_x + 1, COARSE):
        for by in range(low_y, high_y + 1, COARSE):
            for bz in range(low_z, high_z + 1, COARSE):
                if max(n_free, n_mixed) + COARSE**3 > free.shape[0]:
                    return -1, -1
                waiting = _push(stack, 0, bx, by, bz, COARSE)
                while waiting > 0:
                    waiting -= 1
                    x, y, z, size = stack[waiting, 0], stack[waiting, 1], stack[waiting, 2], stack[waiting, 3]
                    kind = _classify(view, table, windows, nearest, 0 if size == 1 else 1, size, x, y, z)
                    if kind == FREE:
                        n_free = _enter(free, n_free, x, y, z, size)
                    elif kind == MIXED and size == 1:
                        n_mixed = _enter(mixed, n_mixed, x, y, z, size)
                    elif kind == MIXED:
                        half = size >> 1
                        for i in range(8):
                            waiting = _push(
                                stack, waiting, x + half * (i >> 2), y + half * ((i >> 1) & 1), z + half * (i & 1), half
                            )
    return n_free, n_mixed


@kernel
def with_hits(view, table, hit_table, hit_coords, n_hits, free, n_free, mixed, n_mixed, hit_of, listed, free_values):
    """Move all blocks that hold hits to the mixed ones; return the numbers of free and of mixed blocks.

    `mixed` must have room for `n_hits` more. hit_of: as long as `mixed`, written: the index of each mixed block among
    the hits, -1 for none. listed: (n_hits,) uint8 zeros, scratch. free_values: (n_free,) int16, written: the evidence
    on all cells of each free block.
    """
    for i in range(n_mixed):
        h = find(hit_table, hit_coords, mixed[i, 0], mixed[i, 1], mixed[i, 2])
        hit_of[i] = h
        if h >= 0:
            listed[h] = 1
    kept = 0
    for i in range(n_free):
        x, y, z = free[i, 0], free[i, 1], free[i, 2]
        if find(hit_table, hit_coords, x, y, z) < 0:
            free[kept, 0], free[kept, 1], free[kept, 2] = x, y, z
            kept += 1
    for h in range(n_hits):  # in blocks that were free, and in blocks on the very border of the view
        if not listed[h]:
            for axis in range(3):
                mixed[n_mixed, axis] = hit_coords[h, axis]
            hit_of[n_mixed] = h
            n_mixed += 1
    _pass(view, table, free[:kept], free_values)
    return kept, n_mixed


@kernel
def evaluate(depth_m, view, table, windows, blocks, hit_of, hit_values, values, scratch):
    """Fill `values` (n, 512) int16 with the evidence on the cells of `blocks` (n, 3), hits included.

    depth_m: (h, w) REP 117 depth image, from which `windows` was made. hit_of: (n,) index of each block among the hits,
    -1 for none. scratch: a `LayerScratch`.
    """
    for i in range(blocks.shape[0]):
        cx, cy, cz = corner(view, blocks[i, 0], blocks[i, 1], blocks[i, 2])
        out = values[i]
        _clear(view, table, windows, cx, cy, cz, scratch, out)
        if table.marks:
            for c in range(512):
                mark = marked(depth_m, view, table, cx, cy, cz, c)
                out[c] = np.int16(mark) if mark > 0 else out[c]
        if hit_of[i] >= 0:
            hits = hit_values[hit_of[i]]
            for c in range(512):
                out[c] = with_hit(out[c], hits[c])


@cell
def _pass(view, table, blocks, out):
    """Write the evidence (n,) on all cells of each of `blocks` (n, 3), which are wholly free."""
    for i in range(blocks.shape[0]):
        _, _, cz = corner(view, blocks[i, 0], blocks[i, 1], blocks[i, 2])
        out[i] = np.int16(_passed(view, table, table.passed, cz))


@cell
def corner(view, bx, by, bz):
    """Return the corner of block (bx, by, bz) in camera axes, x and y times the focal length."""
    side = np.float32(8) * view.voxel_size
    R = view.rotation
    px = np.float32(bx) * side - view.position[0]
    py = np.float32(by) * side - view.position[1]
    pz = np.float32(bz) * side - view.position[2]
    x = (R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz) * view.intrinsics[0]
    y = (R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz) * view.intrinsics[1]
    return x, y, R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz


@cell
def with_hit(value, hit):
    """Return the evidence on a cell that also has `hit`, 0 for none; both int16."""
    return max(value, hit) if hit > 0 else value


@cell
def _push(stack, waiting, x, y, z, size):
    """Push a box on the stack; return the new height of the stack."""
    stack[waiting, 0], stack[waiting, 1], stack[waiting, 2], stack[waiting, 3] = x, y, z, size
    return waiting + 1


@cell
def _enter(blocks, n, x, y, z, size):
    """List all blocks of a box `size` blocks wide; return the new length of the list."""
    for i in range(size):
        for j in range(size):
            for k in range(size):
                blocks[n, 0], blocks[n, 1], blocks[n, 2] = x + i, y + j, z + k
                n += 1
    return n


@cell
def _touched(view, end, axis):
    """Return the first blocks of the first and the last coarse box that the view up to `end` touches along an axis."""
    last_u, last_v = view.columns.size - 1, view.rows.shape[0] - 1
    rim_x = (view.rim[0] / end + ONE) / view.intrinsics[0]
    rim_y = (view.rim[1] / end + ONE) / view.intrinsics[1]
    low = high = ZERO
    for corner in range(4):
        x = view.columns[last_u] + rim_x if corner & 1 else view.columns[0] - rim_x
        y = view.rows[last_v, 0] + rim_y if corner & 2 else view.rows[0, 0] - rim_y
        reached = end * (x * view.forward[0, axis] + y * view.forward[1, axis] + view.forward[2, axis])
        low, high = min(low, reached), max(high, reached)
    side = np.float32(8 * COARSE) * view.voxel_size
    first = np.int64(floor((view.position[axis] + low - view.voxel_size) / side))
    last = np.int64(floor((view.position[axis] + high + view.voxel_size) / side))
    return first * COARSE, last * COARSE


@cell
def _classify(view, table, windows, nearest, tile, blocks, bx, by, bz):
    """Return whether all cells of a box are free (FREE), untouched (SKIP) or neither (MIXED).

    The box is `blocks` blocks wide and starts at block (bx, by, bz); only the centres of its cells count.
    tile: 0 for tiles of 16 pixels (blocks), 1 for 64 (larger boxes).
    """
    side = np.float32(8) * view.voxel_size
    half = (np.float32(4 * blocks) - HALF) * view.voxel_size
    middle = np.float32(blocks) * HALF
    px = (np.float32(bx) + middle) * side - view.position[0]
    py = (np.float32(by) + middle) * side - view.position[1]
    pz = (np.float32(bz) + middle) * side - view.position[2]
    R = view.rotation
    z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
    ez = half * _extent(R, 2)
    z_low, z_high = z - ez, z + ez
    blind = NEAR_PLANE if table.marks else max(NEAR_PLANE, table.blind)  # marks may be nearer
    if z_high <= blind or z_low > view.max_range or _outside(view, half, px, py, pz):
        return SKIP
    if z_low <= max(NEAR_PLANE, table.blind):
        return MIXED
    x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
    y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
    ex, ey = half * _extent(R, 0), half * _extent(R, 1)
    near, far = ONE / z_low, ONE / z_high
    u_low = view.intrinsics[0] * (x - ex) * (near if x < ex else far) + view.intrinsics[2] - SLACK
    u_high = view.intrinsics[0] * (x + ex) * (near if x > -ex else far) + view.intrinsics[2] + SLACK
    v_low = view.intrinsics[1] * (y - ey) * (near if y < ey else far) + view.intrinsics[3] - SLACK
    v_high = view.intrinsics[1] * (y + ey) * (near if y > -ey else far) + view.intrinsics[3] + SLACK
    right, bottom = np.float32(view.width - 1), np.float32(view.height - 1)
    u0, u1 = _pixel(u_low, right), _pixel(u_high, right)
    v0, v1 = _pixel(v_low, bottom), _pixel(v_high, bottom)
    finest = min(max(window_level(view.spread * far), windows.first), np.int32(COARSEST))
    coarsest = min(max(window_level(view.spread * near), windows.first), np.int32(COARSEST))
    farthest = ZERO
    for level in range(finest, coarsest + 1):
        farthest = max(farthest, _extreme(windows, windows.highs, level, tile, u0, u1, v0, v1, True))
    if not table.marks and z_low > (farthest + _behind(table, farthest, view.max_range)) * (ONE + SLACK):
        return SKIP
    whole = u_low >= -HALF and v_low >= -HALF and u_high <= right + HALF and v_high <= bottom + HALF
    if not whole or z_high > view.max_range:
        return MIXED
    closest = NO_RETURN
    for level in range(finest, coarsest + 1):
        closest = min(closest, _extreme(windows, windows.lows, level, tile, u0, u1, v0, v1, False))
    if not table.edges:
        closest = clear_to(table, closest)
    if table.marks:
        closest = min(closest, clear_to(table, _nearest(nearest, tile, u0, u1, v0, v1)))
    return FREE if z_high < closest * (ONE - SLACK) else MIXED


@cell
def _extent(rotation, axis):
    """Return the half width of a box of half width 1 along one axis of the camera."""
    return abs(rotation[axis, 0]) + abs(rotation[axis, 1]) + abs(rotation[axis, 2])


@cell
def _outside(view, half, px, py, pz):
    """Return whether a box of half width `half` about (px, py, pz) is wholly beyond one side of the image."""
    for side in range(4):
        plane = view.sides[side]
        height = plane[0] * px + plane[1] * py + plane[2] * pz + half * plane[3] + plane[4]
        if height < ZERO:
            return True
    return False


@cell
def _behind(table, farthest, max_range):
    """Return how far behind a measurement the sensor model still gives evidence."""
    if not table.marks:
        return table.behind
    return table.reach[table_row(min(farthest, max_range), table.rows_per_metre, table.hit.size)]


@cell
def _pixel(x, last):
    return np.int32(min(max(x + HALF, ZERO), last))


@cell
def _extreme(windows, image, level, tile, u0, u1, v0, v1, highest):
    """Return the highest (or lowest) window value over the tiles that pixels u0..u1, v0..v1 touch."""
    shift = max(level - 1, 0) + (4 if tile == 0 else 6)
    width = windows.tile_width[level, tile]
    start = windows.tile_offset[level, tile]
    best = ZERO if highest else NO_RETURN
    for v in range(v0 >> shift, (v1 >> shift) + 1):
        for u in range(u0 >> shift, (u1 >> shift) + 1):
            value = image[start + v * width + u]
            best = max(best, value) if highest else min(best, value)
    return best


@cell
def _nearest(nearest, tile, u0, u1, v0, v1):
    image = nearest[tile]
    shift = 4 if tile == 0 else 6
    best = NO_RETURN
    for v in range(v0 >> shift, (v1 >> shift) + 1):
        for u in range(u0 >> shift, (u1 >> shift) + 1):
            best = min(best, image[v, u])
    return best


@cell
def _passed(view, table, passed, cz):
    """Return the largest loss of the cells of a block that are seen through, by the depth of its centre.

    passed: (rows,) of the table, of plain cells or of those next to an edge. cz: depth of the block's corner.
    """
    R = view.rotation
    z = cz + np.float32(4) * view.voxel_size * (R[2, 0] + R[2, 1] + R[2, 2])
    return passed[table_row(min(max(z, ZERO), view.max_range), table.rows_per_metre, passed.size)]


@cell
def _clear(view, table, windows, cx, cy, cz, scratch, out):
    """Write the negative evidence of how far one sees through a window of about the cell's size.

    scratch: see `evaluate`.
    """
    depths, measured, clear, at, _ = scratch
    R = view.rotation
    farther = max(R[2, 0], ZERO) + max(R[2, 1], ZERO) + max(R[2, 2], ZERO)
    z_most = max(cz + np.float32(8) * view.voxel_size * farther, ZERO)
    before = table.before[table_row(min(z_most, view.max_range), table.rows_per_metre, table.before.size)]
    lowest, at_edge = _passed(view, table, table.passed, cz), _passed(view, table, table.edged, cz)
    for layer in range(0, 512, LAYER):
        cells = slice(layer, layer + LAYER)
        steps = view.steps[0, cells], view.steps[1, cells], view.steps[2, cells]
        _aim(view, windows, max(NEAR_PLANE, table.blind), cx, cy, cz, steps, depths, at)
        _load(windows.image, at, measured)
        if table.edges:
            _load(windows.clear, at, clear)
        else:
            clear[:] = UNSEEN
        if _write_free_layer(depths, measured, clear, before, table.behind, lowest, at_edge, out[cells]):
            _look_up(view, table, scratch, at_edge, out[cells])


# Computing indices, loading from them and computing with the loaded values are separate loops, here and below: most
# processors have no fast gather instruction, and for them the compiler would not vectorise a loop that contains one.


@cell
def _aim(view, windows, nearest, cx, cy, cz, steps, depths, at):
    """Fill `depths` with the depth of each cell's centre and `at` with the index of its window value.

    nearest: depth up to which cells are skipped.
    """
    fx_steps, fy_steps, z_steps = steps
    for c in range(LAYER):
        z = cz + z_steps[c]
        depths[c] = z
        at[c] = window_place(view, windows, nearest, cx + fx_steps[c], cy + fy_steps[c], z)


@cell
def window_place(view, windows, nearest, x, y, z):
    """Return the index of a cell's window value; for a cell that is skipped or not seen, of UNSEEN.

    x, y, z: its centre in camera axes, x and y times the focal length. nearest: depth up to which cells are skipped.
    """
    u_centre, v_centre = view.intrinsics[2] + HALF, view.intrinsics[3] + HALF
    right, bottom = np.float32(view.width - 1), np.float32(view.height - 1)
    u_end, v_end = np.float32(view.width), np.float32(view.height)
    first, last = np.int32(windows.first), np.int32(COARSEST)
    ahead = (z > nearest) & (z <= view.max_range)
    inverse = ONE / (z if ahead else ONE)
    u = x * inverse + u_centre
    v = y * inverse + v_centre
    u_rim, v_rim = view.rim[0] * inverse, view.rim[1] * inverse
    seen = ahead & (u >= -u_rim) & (v >= -v_rim) & (u < u_end + u_rim) & (v < v_end + v_rim)
    level = min(max(window_level(view.spread * inverse), first), last)
    i = place(level, min(max(v, ZERO), bottom), min(max(u, ZERO), right), windows.pitch, windows.height)
    return i if seen else np.int32(windows.image.size - 1)


@cell
def _load(values, at, out):
    for c in range(LAYER):
        out[c] = values[index(at[c])]


@cell
def _write_free_layer(depths, measured, clear, before, behind, lowest, at_edge, out):
    """Write the loss of cells wholly before their measurement, else 0; return whether any is near its measurement."""
    near = np.int32(0)
    for c in range(LAYER):
        ahead = measured[c] - depths[c]
        is_clear = depths[c] < clear[c]
        out[c] = np.int16(lowest if is_clear else (at_edge if ahead > before else np.int32(0)))
        near |= np.int32((ahead <= before) & (ahead >= -behind) & (measured[c] > ZERO) & ~is_clear)
    return near != 0


@cell
def _look_up(view, table, scratch, at_edge, out):
    """Write the sensor table's evidence on cells that are not wholly before their measurement, never below `at_edge`.

    out: of the others, unchanged.
    """
    depths, measured, scale, at, row = scratch
    for c in range(LAYER):
        row[c] = measured_row(view, table, measured[c])
    _load(table.columns_per_metre, row, scale)
    for c in range(LAYER):
        at[c] = table_place(table, row[c], depths[c] - measured[c], scale[c])
    _load(table.clear.reshape(table.clear.size), at, row)
    for c in range(LAYER):
        out[c] = min(out[c], cleared(row[c], at_edge, measured[c]))


@cell
def measured_row(view, table, measured):
    """Return the table row of a window value."""
    last_row = np.int32(table.hit.size - 1)
    return min(np.int32(min(max(measured, ZERO), view.max_range) * table.rows_per_metre), last_row)


@cell
def table_place(table, row, behind, scale):
    """Return the index, in the flat table, of the evidence on a cell `behind` metres behind a measurement.

    scale: table columns per metre in this row.
    """
    columns = np.int32(table.clear.shape[1])
    last_column, middle_column = np.float32(columns - 1), np.float32(columns) * HALF
    t = behind * scale + middle_column
    return np.int32(np.int32(row * columns) + np.int32(min(max(t, ZERO), last_column)))


@cell
def cleared(said, lowest, measured):
    """Return the evidence on a cell by its table entry `said`, never below `lowest`; 0 without a measurement."""
    return np.int16(max(said, lowest) if measured > ZERO else np.int32(0))


@cell
def marked(depth_m, view, table, cx, cy, cz, c):
    """Return the positive evidence of the pixel at the centre of cell `c` of a block, 0 for none."""
    rows = table.hit.size
    last_column, middle_column = np.float32(table.mark.shape[1] - 1), np.float32(table.mark.shape[1]) * HALF
    z = cz + view.steps[2, c]
    if z <= NEAR_PLANE or z > view.max_range:
        return np.int32(0)
    u = (cx + view.steps[0, c]) / z + (view.intrinsics[2] + HALF)
    v = (cy + view.steps[1, c]) / z + (view.intrinsics[3] + HALF)
    if not (u >= ZERO and v >= ZERO and u < np.float32(view.width) and v < np.float32(view.height)):
        return np.int32(0)
    d = depth_m[np.int32(v), np.int32(u)]
    if not (d > ZERO and d < NO_RETURN):
        return np.int32(0)
    row = table_row(d, table.rows_per_metre, rows)
    t = (z - d) * table.columns_per_metre[row] + middle_column
    if t < ZERO or t > last_column:
        return np.int32(0)
    return table.mark[row, np.int32(t)]
