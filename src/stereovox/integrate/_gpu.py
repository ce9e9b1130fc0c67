# SPDX-License-Identifier: Apache-2.0
"""Kernels of the projective integrator on a graphics card: loops over the functions of `_projective.py` and `_hits.py`.

Everything between the depth image and the evidence stays on the card, including the number of blocks of each kind. If
a list is too short, counting continues but the rest is not written; the caller checks the counts at the end, makes room
and repeats the frame. The order of lists differs from run to run; their contents do not.
"""

import numpy as np

from stereovox.integrate import _cells, _hits, _projective, _windows
from stereovox.integrate._cells import HALF, NARROW, NEAR_PLANE, NO_RETURN, ONE, WIDE, ZERO
from stereovox.integrate._hits import NOTHING
from stereovox.integrate._projective import COARSE, FREE, MIXED
from stereovox.integrate._windows import COARSEST
from stereovox.kernels._gpu import cuda, gpu_kernel, on_gpu
from stereovox.maps.cells import _cells as _map_cells
from stereovox.maps.cells._cells import EMPTY

LARGE, MIDDLE, SEEN_FREE, SEEN_MIXED, FREE_BLOCKS, LISTED, HIT_BLOCKS = 0, 1, 2, 3, 4, 5, 6
"""Places in `counts` (COUNTS,) int32: mixed boxes of four and of two blocks, free and mixed blocks of the view, free
blocks without hits, cells with hits, and blocks with hits."""
COUNTS = 7
NARROW_BLOCK, WIDE_BLOCK = (~np.int64((7 << 2 * bits) | (7 << bits) | 7) for bits in (NARROW, WIDE))
"""Masks that turn the key of a cell into the key of its block's first cell."""
MIXER = np.uint64(0x9E3779B97F4A7C15)

place, usable, unpack = on_gpu(_windows.place), on_gpu(_cells.usable), on_gpu(_cells.unpack)
nearness, seen_through, farthest_of = (
    on_gpu(_windows.nearness),
    on_gpu(_windows.seen_through),
    on_gpu(_windows.farthest_of),
)
next_is_coarser, clear_to = on_gpu(_windows.next_is_coarser), on_gpu(_windows.clear_to)
touched, classify, passed_by, end_of_view = (
    on_gpu(_projective._touched), on_gpu(_projective._classify), on_gpu(_projective._passed),
    on_gpu(_projective._end_of_view),
)  # fmt: skip
enter_box, corner, window_place = (
    on_gpu(_projective._enter), on_gpu(_projective.corner), on_gpu(_projective.window_place),
)  # fmt: skip
measured_row, table_place, cleared = (
    on_gpu(_projective.measured_row), on_gpu(_projective.table_place), on_gpu(_projective.cleared),
)  # fmt: skip
marked, with_hit = on_gpu(_projective.marked), on_gpu(_projective.with_hit)
row_rays, narrow_offset = on_gpu(_hits._row_rays), on_gpu(_hits.narrow_offset)
narrow_key, wide_key = on_gpu(_hits.narrow_key), on_gpu(_hits.wide_key)
centre, samples_across, sample = on_gpu(_hits.centre), on_gpu(_hits.samples_across), on_gpu(_hits.sample)
share_of, hit_row, weighed_hit = on_gpu(_hits.share_of), on_gpu(_hits.hit_row), on_gpu(_hits.weighed_hit)
find, home_slot = on_gpu(_map_cells.find), on_gpu(_map_cells.home_slot)


@gpu_kernel
def shrink(depth_m, base, windows, level):
    """Fill `level` of `base`, from 1 on: how far one sees through each tile of 2^(level - 1) pixels; see `_windows`.

    depth_m: flat REP 117 depth image. base: like `windows.image`; the previous level is filled.
    """
    shape, pitch, height = windows.shape, windows.pitch, windows.height
    rows, columns = shape[level, 0], shape[level, 1]
    start = place(np.int32(level), ZERO, ZERO, pitch, height)
    finer = place(np.int32(level - 1), ZERO, ZERO, pitch, height)
    for i in range(cuda.grid(1), rows * columns, cuda.gridsize(1)):
        v, u = i // columns, i % columns
        if level == 1:
            through = usable(depth_m[i])
        else:
            nearest, known = NO_RETURN, ZERO
            for part in range(4):
                line = min(2 * v + (part >> 1), shape[level - 1, 0] - 1)
                column = min(2 * u + (part & 1), shape[level - 1, 1] - 1)
                value = base[finer + line * pitch + column]
                nearest = min(nearest, nearness(value))
                known += ONE if value > ZERO else ZERO
            through = seen_through(nearest, known)
        base[start + v * pitch + u] = through


@gpu_kernel
def widen(base, windows):
    """Fill the window images of all levels from `windows.first` on: for each pixel of `base` the farthest of 3x3."""
    for level in range(windows.first, COARSEST + 1):
        rows, columns = windows.shape[level, 0], windows.shape[level, 1]
        start = place(np.int32(level), ZERO, ZERO, windows.pitch, windows.height)
        source = place(np.int32(max(level, 1)), ZERO, ZERO, windows.pitch, windows.height)
        reach = 0 if level == 0 else 1
        for i in range(cuda.grid(1), rows * columns, cuda.gridsize(1)):
            v, u = i // columns, i % columns
            farthest = ZERO
            for line in range(max(v - reach, 0), min(v + reach, rows - 1) + 1):
                for column in range(max(u - reach, 0), min(u + reach, columns - 1) + 1):
                    farthest = max(farthest, base[source + line * windows.pitch + column])
            windows.image[start + v * windows.pitch + u] = farthest


@gpu_kernel
def widen_clear(base, windows, table):
    """Fill the clear depths of all levels from `windows.first` on, whose window images are filled."""
    shape, pitch = windows.shape, windows.pitch
    for level in range(windows.first, COARSEST + 1):
        rows, columns = shape[level, 0], shape[level, 1]
        start = place(np.int32(level), ZERO, ZERO, pitch, windows.height)
        finer = 1 if next_is_coarser(level) else 0
        coarser = max(level + finer, 1)
        source = place(np.int32(coarser), ZERO, ZERO, pitch, windows.height)
        for i in range(cuda.grid(1), rows * columns, cuda.gridsize(1)):
            v, u = i // columns, i % columns
            nearest = NO_RETURN
            for line in range(max((v >> finer) - 1, 0), min((v >> finer) + 1, shape[coarser, 0] - 1) + 1):
                for column in range(max((u >> finer) - 1, 0), min((u >> finer) + 1, shape[coarser, 1] - 1) + 1):
                    nearest = min(nearest, nearness(base[source + line * pitch + column]))
            at = start + v * pitch + u
            windows.clear[at] = clear_to(table, nearest) if windows.image[at] > ZERO else ZERO


@gpu_kernel
def fill_tiles(windows, edges):
    """Fill the tiles of 16 pixels of all levels from `windows.first` on; edges: whether there are clear depths."""
    for level in range(windows.first, COARSEST + 1):
        rows, columns = windows.shape[level, 0], windows.shape[level, 1]
        start = place(np.int32(level), ZERO, ZERO, windows.pitch, windows.height)
        across, offset = windows.tile_width[level, 0], windows.tile_offset[level, 0]
        for i in range(cuda.grid(1), across * ((rows + 15) >> 4), cuda.gridsize(1)):
            v, u = 16 * (i // across), 16 * (i % across)
            nearest, farthest = NO_RETURN, ZERO
            for line in range(v, min(v + 16, rows)):
                for column in range(u, min(u + 16, columns)):
                    at = start + line * windows.pitch + column
                    least = windows.clear[at] if edges else windows.image[at]
                    nearest, farthest = min(nearest, least), max(farthest, windows.image[at])
            windows.lows[offset + i], windows.highs[offset + i] = nearest, farthest


@gpu_kernel
def join_tiles(windows):
    """Fill the tiles of 64 pixels from those of 16."""
    for level in range(windows.first, COARSEST + 1):
        small, offset = windows.tile_width[level, 0], windows.tile_offset[level, 0]
        down = (windows.shape[level, 0] + 15) >> 4
        across, big = windows.tile_width[level, 1], windows.tile_offset[level, 1]
        for i in range(cuda.grid(1), across * ((windows.shape[level, 0] + 63) >> 6), cuda.gridsize(1)):
            v, u = 4 * (i // across), 4 * (i % across)
            nearest, farthest = NO_RETURN, ZERO
            for line in range(v, min(v + 4, down)):
                for column in range(u, min(u + 4, small)):
                    at = offset + line * small + column
                    nearest, farthest = min(nearest, windows.lows[at]), max(farthest, windows.highs[at])
            windows.lows[big + i], windows.highs[big + i] = nearest, farthest


@gpu_kernel
def nearest_tiles(depth_m, height, width, size, tiles):
    """Fill `tiles` of `size` pixels with their nearest depth, ignoring pixels without value."""
    across = tiles.shape[1]
    for i in range(cuda.grid(1), tiles.size, cuda.gridsize(1)):
        v, u = size * (i // across), size * (i % across)
        nearest = NO_RETURN
        for line in range(v, min(v + size, height)):
            for column in range(u, min(u + size, width)):
                d = depth_m[line * width + column]
                nearest = min(nearest, d if d > ZERO else NO_RETURN)
        tiles[i // across, i % across] = nearest


@gpu_kernel
def find_boxes(view, table, windows, boxes):
    """Write the first coarse box along each axis, and the number of boxes, to `boxes` (3, 2) int32."""
    if cuda.grid(1) == 0:
        end = end_of_view(view, table, view.max_range if table.marks else farthest_of(windows))
        for axis in range(3):
            low, high = touched(view, end, axis)
            boxes[axis, 0], boxes[axis, 1] = low, (high - low) // COARSE + 1


@gpu_kernel
def cull_coarse(view, table, windows, nearest, boxes, free, mixed, counts):
    """Classify all coarse boxes: list the blocks of free ones, and in `mixed` (room, 3) the mixed boxes."""
    nx, ny, nz = boxes[0, 1], boxes[1, 1], boxes[2, 1]
    for i in range(cuda.grid(1), nx * ny * nz, cuda.gridsize(1)):
        x = boxes[0, 0] + COARSE * (i // (ny * nz))
        y = boxes[1, 0] + COARSE * (i // nz % ny)
        z = boxes[2, 0] + COARSE * (i % nz)
        kind = classify(view, table, windows, nearest, 1, COARSE, x, y, z)
        if kind == FREE:
            n = cuda.atomic.add(counts, SEEN_FREE, COARSE * COARSE * COARSE)
            if n + COARSE * COARSE * COARSE <= free.shape[0]:
                enter_box(free, n, x, y, z, COARSE)
        elif kind == MIXED:
            n = cuda.atomic.add(counts, LARGE, 1)
            if n < mixed.shape[0]:
                mixed[n, 0], mixed[n, 1], mixed[n, 2] = x, y, z


@gpu_kernel
def cull(view, table, windows, nearest, larger, counted, half, free, mixed, listed, counts):
    """Classify the eight parts, `half` blocks wide, of each of the `larger` boxes, as `cull_coarse` does.

    counted, listed: indices into `counts` of the numbers of `larger` and `mixed` boxes.
    """
    parts = 8 * min(counts[counted], larger.shape[0])
    volume = half * half * half
    for i in range(cuda.grid(1), parts, cuda.gridsize(1)):
        box, part = i >> 3, i & 7
        x = larger[box, 0] + half * (part >> 2)
        y = larger[box, 1] + half * ((part >> 1) & 1)
        z = larger[box, 2] + half * (part & 1)
        kind = classify(view, table, windows, nearest, 0 if half == 1 else 1, half, x, y, z)
        if kind == FREE:
            n = cuda.atomic.add(counts, SEEN_FREE, volume)
            if n + volume <= free.shape[0]:
                enter_box(free, n, x, y, z, half)
        elif kind == MIXED:
            n = cuda.atomic.add(counts, listed, 1)
            if n < mixed.shape[0]:
                mixed[n, 0], mixed[n, 1], mixed[n, 2] = x, y, z


@gpu_kernel
def list_cells(depth_m, view, wide, claims, listed, counts):
    """List the keys of all cells that hold a measured point, each once.

    depth_m: flat REP 117 depth image. wide: whether keys need 64 bits. claims: hash filled with NOTHING, its size a
    power of two. listed: (pixels,) int64.
    """
    size = ONE / view.voxel_size
    position = view.position[0] * size, view.position[1] * size, view.position[2] * size
    offset = narrow_offset(position)
    for i in range(cuda.grid(1), depth_m.size, cuda.gridsize(1)):
        v, u, d = i // view.width, i % view.width, depth_m[i]
        if d > ZERO and d < NO_RETURN:
            ray = row_rays(view.forward, view.rows[v], size)
            if wide:
                key = np.int64(wide_key(d, view.columns[u], ray, position))
            else:
                key = np.int64(narrow_key(d, view.columns[u], ray, offset))
            slot = np.int64((np.uint64(key) * MIXER) >> np.uint64(32)) & (claims.size - 1)
            held = claims[slot]
            while held != key:
                if held == NOTHING:
                    held = cuda.atomic.cas(claims, slot, NOTHING, key)
                    if held == NOTHING:
                        listed[cuda.atomic.add(counts, LISTED, 1)] = key
                        break
                else:
                    slot = (slot + 1) & (claims.size - 1)
                    held = claims[slot]


@gpu_kernel
def list_blocks(listed, wide, claims, coords, counts):
    """List the blocks that hold the `listed` cells, each once, in `coords` (room, 3). claims: as in `list_cells`."""
    for i in range(cuda.grid(1), counts[LISTED], cuda.gridsize(1)):
        key = listed[i] & (WIDE_BLOCK if wide else NARROW_BLOCK)
        slot = np.int64((np.uint64(key) * MIXER) >> np.uint64(32)) & (claims.size - 1)
        held = claims[slot]
        while held != key:
            if held == NOTHING:
                held = cuda.atomic.cas(claims, slot, NOTHING, key)
                if held == NOTHING:
                    n = cuda.atomic.add(counts, HIT_BLOCKS, 1)
                    if n < coords.shape[0]:
                        x, y, z = unpack(key, WIDE if wide else NARROW)
                        coords[n, 0], coords[n, 1], coords[n, 2] = x >> 3, y >> 3, z >> 3
                    break
            else:
                slot = (slot + 1) & (claims.size - 1)
                held = claims[slot]


@gpu_kernel
def enter_blocks(table, coords, values, taken, counts):
    """Enter the blocks with hits into an empty hash table, and zero their rows of `values` (room, 512)."""
    n = min(counts[HIT_BLOCKS], coords.shape[0])
    for i in range(cuda.grid(1), n, cuda.gridsize(1)):
        slot = home_slot(coords[i, 0], coords[i, 1], coords[i, 2], table.size - 1)
        while cuda.atomic.cas(table, slot, EMPTY, np.int32(i)) != EMPTY:
            slot = (slot + 1) & (table.size - 1)
        taken[i] = 0
    for i in range(cuda.grid(1), 512 * n, cuda.gridsize(1)):
        values[i >> 9, i & 511] = 0


@gpu_kernel
def weigh(depth_m, view, table, full_share, listed, wide, hit_table, coords, values, counts):
    """Write the evidence of each of the `listed` cells to `values`, as `_hits.weigh` does. depth_m: flat."""
    limit = HALF * view.voxel_size
    for i in range(cuda.grid(1), counts[LISTED], cuda.gridsize(1)):
        cell_x, cell_y, cell_z = unpack(listed[i], WIDE if wide else NARROW)
        bx, by, bz = cell_x >> 3, cell_y >> 3, cell_z >> 3
        c = ((cell_x & 7) << 6) | ((cell_y & 7) << 3) | (cell_z & 7)
        row = find(hit_table, coords, bx, by, bz)
        if row < 0:
            continue  # there was no room for the block
        block = np.float32(bx), np.float32(by), np.float32(bz)
        x, y, z = centre(view, *block, view.steps[0, c], view.steps[1, c], view.steps[2, c])
        share = full_share
        if full_share > ZERO:
            inverse = ONE / z
            size = min(view.voxel_size * view.intrinsics[0] * inverse, np.float32(view.width))
            samples = samples_across(size)
            step = size / samples
            left = x * inverse + view.intrinsics[2] + HALF - HALF * size
            top = y * inverse + view.intrinsics[3] + HALF - HALF * size
            found, looked = ZERO, ZERO
            for j in range(np.int32(samples)):
                for k in range(np.int32(samples)):
                    down, across = np.float32(j) + HALF, np.float32(k) + HALF
                    counted, at = sample(view, left + across * step, top + down * step)
                    found += counted if abs(depth_m[at] - z) <= limit else ZERO
                    looked += counted
            share = share_of(found, looked)
        values[row, c] = weighed_hit(np.float32(table.hit[hit_row(view, table, z)]), full_share, share)


@gpu_kernel
def match_hits(hit_table, hit_coords, mixed, hit_of, taken, counts):
    """Write the index of each mixed block among the hits, -1 for none, and mark those hits as `taken`."""
    for i in range(cuda.grid(1), min(counts[SEEN_MIXED], mixed.shape[0]), cuda.gridsize(1)):
        h = find(hit_table, hit_coords, mixed[i, 0], mixed[i, 1], mixed[i, 2])
        hit_of[i] = h
        if h >= 0:
            taken[h] = 1


@gpu_kernel
def append_hits(hit_coords, mixed, hit_of, taken, counts):
    """Append the blocks with hits that are not `taken` to the mixed ones."""
    for h in range(cuda.grid(1), min(counts[HIT_BLOCKS], hit_coords.shape[0]), cuda.gridsize(1)):
        if taken[h] == 0:
            n = cuda.atomic.add(counts, SEEN_MIXED, 1)
            if n < mixed.shape[0]:
                mixed[n, 0], mixed[n, 1], mixed[n, 2] = hit_coords[h, 0], hit_coords[h, 1], hit_coords[h, 2]
                hit_of[n] = h


@gpu_kernel
def evaluate(depth_m, view, table, windows, origin, mixed, hit_of, hits, counts, coords, values, said):
    """Write the evidence on the cells of the mixed blocks, hits included, to `values` (room, 512) int16.

    depth_m: (h, w) REP 117 depth image. origin: the block that block coordinates count from. coords: written, counted
    from the world's origin. said: written, (room,) int16, 1 for blocks whose values are not all 0.
    """
    for i in range(cuda.blockIdx.x, min(counts[SEEN_MIXED], mixed.shape[0]), cuda.gridDim.x):
        cx, cy, cz = corner(view, mixed[i, 0], mixed[i, 1], mixed[i, 2])
        lowest, at_edge = passed_by(view, table, table.passed, cz), passed_by(view, table, table.edged, cz)
        anything = 0
        for c in range(cuda.threadIdx.x, 512, cuda.blockDim.x):
            z = cz + view.steps[2, c]
            x, y = cx + view.steps[0, c], cy + view.steps[1, c]
            window = window_place(view, windows, max(NEAR_PLANE, table.blind), x, y, z)
            measured = windows.image[window]
            row = measured_row(view, table, measured)
            at = table_place(table, row, z - measured, table.columns_per_metre[row])
            value = cleared(table.clear[at // table.clear.shape[1], at % table.clear.shape[1]], at_edge, measured)
            value = np.int16(lowest) if table.edges and z < windows.clear[window] else value
            if table.marks:
                mark = marked(depth_m, view, table, cx, cy, cz, c)
                value = np.int16(mark) if mark > 0 else value
            if hit_of[i] >= 0:
                value = with_hit(value, hits[hit_of[i], c])
            values[i, c] = value
            anything |= value != 0
        anything = cuda.syncthreads_or(anything)
        if cuda.threadIdx.x == 0:
            said[i] = 1 if anything else 0
            for axis in range(3):
                coords[i, axis] = mixed[i, axis] + origin[axis]


@gpu_kernel
def passed(view, table, origin, hit_table, hit_coords, free, counts, coords, steps):
    """List the free blocks without hits, counted from the world's origin, and the evidence on all cells of each."""
    for i in range(cuda.grid(1), min(counts[SEEN_FREE], free.shape[0]), cuda.gridsize(1)):
        x, y, z = free[i, 0], free[i, 1], free[i, 2]
        if find(hit_table, hit_coords, x, y, z) < 0:
            n = cuda.atomic.add(counts, FREE_BLOCKS, 1)
            _, _, cz = corner(view, x, y, z)
            steps[n] = np.int16(passed_by(view, table, table.passed, cz))
            coords[n, 0], coords[n, 1], coords[n, 2] = x + origin[0], y + origin[1], z + origin[2]


@gpu_kernel
def reset(claims, block_claims, hit_table, counts):
    """Clear the remains of the previous frame."""
    for i in range(cuda.grid(1), claims.size, cuda.gridsize(1)):
        claims[i] = block_claims[i] = NOTHING
    for i in range(cuda.grid(1), hit_table.size, cuda.gridsize(1)):
        hit_table[i] = EMPTY
    for i in range(cuda.grid(1), counts.size, cuda.gridsize(1)):
        counts[i] = 0
