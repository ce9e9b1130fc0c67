# SPDX-License-Identifier: Apache-2.0
"""Kernels that scatter measured points into their cells, and weigh each hit by its share of the cell's footprint.

Most pixels fall into the cell of their left or upper neighbour. Each pixel's cell is packed into one number, and only
pixels whose number differs from their neighbours' are processed; groups without any cost one test.
"""

import numpy as np

from stereovox.integrate._cells import (
    HALF,
    NARROW,
    NEAR_PLANE,
    NO_RETURN,
    ONE,
    WIDE,
    ZERO,
    bits,
    index,
    table_row,
    unpack,
)
from stereovox.kernels._jit import cell, kernel
from stereovox.kernels._math import floor, square_root
from stereovox.maps.cells._cells import find_or_insert

SEEN_BITS = 11
SEEN = 1 << SEEN_BITS
GROUP = 8
"""Pixels tested together, as one 64-bit word of eight flags."""
NOTHING = -1
"""Key of a pixel without a measurement."""
SIDE_SAMPLES = 4
"""Most samples along each side of a cell's footprint."""
LANES = 64
"""Cells that are weighed together."""


@kernel
def scatter(depth_m, view, scratch, listed, pool_table, coords, count, values):
    """Set every cell that holds a measured point to 1; return how many there are, -1 if the block pool is full.

    depth_m: (h, w) REP 117 depth image. scratch: `HitScratch`. Block coordinates count from the camera's block.
    listed: (pixels,) int32, written: the cells that were set, as 512 * index of the block in the pool + cell in it.
    """
    keys, news, fresh, seen = scratch
    size = np.float32(1) / view.voxel_size
    position = view.position[0] * size, view.position[1] * size, view.position[2] * size
    last, place = (np.int32(0), np.int32(0), np.int32(0)), np.int64(-1)
    b, n = np.int64(bits(keys)), 0
    keys[:, :] = NOTHING
    seen[:] = NOTHING
    for v in range(depth_m.shape[0]):
        now, before = keys[v & 1], keys[1 - (v & 1)]
        ray = _row_rays(view.forward, view.rows[v], size)
        if keys.itemsize == 4:
            _narrow_row(depth_m[v], view.columns, ray, position, now, before, news)
        else:
            _wide_row(depth_m[v], view.columns, ray, position, now, before, news)
        for i in range(_gather_news(news, fresh)):
            key = now[fresh[i]]
            slot = _slot(key)
            if seen[slot] == key:
                continue
            seen[slot] = key
            x, y, zz = unpack(key, b)
            block = (x >> 3, y >> 3, zz >> 3)
            if place < 0 or block != last:
                place = find_or_insert(pool_table, coords, count, block[0], block[1], block[2])
                last = block
            if place < 0:
                return -1
            c = ((x & 7) << 6) | ((y & 7) << 3) | (zz & 7)
            if values[place, c] == 0:
                values[place, c] = 1
                listed[n] = (place << 9) | c
                n += 1
    return n


@kernel
def weigh(depth_m, view, table, full_share, listed, coords, values, lanes):
    """Replace the ones that `scatter` set by the evidence of a hit at the depth of the cell's centre.

    A hit counts in full if at least `full_share` of the cell's footprint in the image measures a depth within the cell;
    else by the square root of the ratio: a few pixels may be a matching error. full_share 0: always in full.
    listed: (n,) cells that `scatter` set. lanes: a `HitLanes`, scratch.
    """
    flat, values_flat = depth_m.reshape(depth_m.size), values.reshape(values.size)
    for start in range(0, listed.size, LANES):
        some = listed[start : min(start + LANES, listed.size)]
        _centres(view, coords, some, lanes)
        for i in range(some.size):
            lanes.share[i] = full_share
        if full_share > ZERO:
            _share(flat, view, some.size, lanes)
        _evidence(view, table, full_share, some, lanes, values_flat)


@cell
def _centres(view, coords, listed, lanes):
    """Write the centres of listed cells in camera axes, x and y times the focal length."""
    x, y, z, px, py, pz = lanes.x, lanes.y, lanes.z, lanes.u, lanes.v, lanes.step
    n = listed.size
    for i in range(n):  # a loop of its own: see `_projective._aim`
        block, c = np.uint32(listed[i] >> 9), np.uint32(listed[i] & 511)
        px[i] = np.float32(coords[block, 0])
        py[i] = np.float32(coords[block, 1])
        pz[i] = np.float32(coords[block, 2])
        x[i], y[i], z[i] = view.steps[0, c], view.steps[1, c], view.steps[2, c]
    for i in range(n):
        x[i], y[i], z[i] = centre(view, px[i], py[i], pz[i], x[i], y[i], z[i])


@cell
def centre(view, bx, by, bz, x_step, y_step, z_step):
    """Return the centre of a cell in camera axes, x and y times the focal length.

    All float32: the block's coordinates, and the cell's entries of `view.steps`.
    """
    side = np.float32(8) * view.voxel_size
    R = view.rotation
    px, py, pz = bx * side - view.position[0], by * side - view.position[1], bz * side - view.position[2]
    x = (R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz) * view.intrinsics[0] + x_step
    y = (R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz) * view.intrinsics[1] + y_step
    return x, y, max(R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + z_step, NEAR_PLANE)


@cell
def _share(depth_m, view, n, lanes):
    """Write the share of each cell's footprint whose pixels measure a depth within half a cell of its centre.

    Samples are evenly spaced, up to SIDE_SAMPLES per side; at least half a sample counts.
    """
    x, y, z, share, u, v, samples, step, looked, depth, counts, at = lanes
    limit = HALF * view.voxel_size
    most = np.int32(1)
    for i in range(n):  # `_gpu.weigh` repeats these lines: a shared cell would round differently, and change maps
        inverse = ONE / z[i]
        wide = min(view.voxel_size * view.intrinsics[0] * inverse, np.float32(view.width))
        samples[i] = samples_across(wide)
        step[i] = wide / samples[i]
        u[i] = x[i] * inverse + view.intrinsics[2] + HALF - HALF * wide
        v[i] = y[i] * inverse + view.intrinsics[3] + HALF - HALF * wide
        share[i] = ZERO
        looked[i] = ZERO
    for i in range(n):
        most = max(most, np.int32(samples[i]))
    for j in range(most):
        row = np.float32(j) + HALF
        for k in range(most):
            column = np.float32(k) + HALF
            for i in range(n):
                counts[i], at[i] = sample(view, u[i] + column * step[i], v[i] + row * step[i])
                counts[i] = counts[i] if (row < samples[i]) & (column < samples[i]) else ZERO
            for i in range(n):  # a loop of its own: see `_projective._aim`
                depth[i] = depth_m[index(at[i])]
            for i in range(n):
                share[i] += counts[i] if abs(depth[i] - z[i]) <= limit else ZERO
                looked[i] += counts[i]
    for i in range(n):
        share[i] = share_of(share[i], looked[i])


@cell
def samples_across(wide):
    """Return the number of samples along each side of a footprint `wide` pixels wide, a float32."""
    return np.float32(np.int32(min(max(wide, ONE), np.float32(SIDE_SAMPLES))))


@cell
def sample(view, u, v):
    """Return whether a point is in the image, 1 or 0, and the index of its pixel, 0 if it is not."""
    inside = (u >= ZERO) & (u < np.float32(view.width)) & (v >= ZERO) & (v < np.float32(view.height))
    at = np.int32(np.int32(v if inside else ZERO) * view.width) + np.int32(u if inside else ZERO)
    return ONE if inside else ZERO, np.int32(at)


@cell
def share_of(share, looked):
    """Return the share of a footprint: samples that measure the cell, of all `looked` samples in the image."""
    return max(share, HALF) / max(looked, ONE)


@cell
def _evidence(view, table, full_share, listed, lanes, values):
    """Write the evidence of the hits on listed cells."""
    z, share, hits, at, n = lanes.z, lanes.share, lanes.depth, lanes.at, listed.size
    for i in range(n):
        at[i] = hit_row(view, table, z[i])
    for i in range(n):
        hits[i] = np.float32(table.hit[index(at[i])])
    for i in range(n):
        at[i] = weighed_hit(hits[i], full_share, share[i])
    for i in range(n):
        values[index(listed[i])] = np.int16(at[i])


@cell
def hit_row(view, table, z):
    """Return the table row of a hit on a cell at depth `z`."""
    return table_row(min(z, view.max_range), table.rows_per_metre, np.int32(table.hit.size))


@cell
def weighed_hit(hit, full_share, share):
    """Return the evidence of a hit (float32) on a cell that a `share` of its footprint measures."""
    part = min(ONE, share / full_share) if full_share > ZERO else ONE
    weighed = max(floor(hit * square_root(part) + HALF), ONE)
    return np.int32(weighed if hit > ZERO else ZERO)


@cell
def _slot(key):
    """Return the slot of a key in `seen`, a small cache of recently entered cells."""
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    return np.int64(mixed >> np.uint64(64 - SEEN_BITS))


@cell
def _row_rays(forward, row, size):
    """Return slope and offset, in cells, of the world point at depth 1 as a function of the column of this row.

    row: (2,) y and z of the row's rays at depth 1; see `stereovox.cameras.pinhole`.
    """
    y, z = row[0], row[1]
    return (
        forward[0, 0] * size, (forward[1, 0] * y + forward[2, 0] * z) * size,
        forward[0, 1] * size, (forward[1, 1] * y + forward[2, 1] * z) * size,
        forward[0, 2] * size, (forward[1, 2] * y + forward[2, 2] * z) * size,
    )  # fmt: skip


@cell
def _point_cell(d, column, ray, position):
    """Return the cell that holds the point at depth `d` of the pixel with x/z `column`."""
    return (
        np.int32(floor(d * (ray[0] * column + ray[1]) + position[0])),
        np.int32(floor(d * (ray[2] * column + ray[3]) + position[1])),
        np.int32(floor(d * (ray[4] * column + ray[5]) + position[2])),
    )


@cell
def _narrow_row(depths, columns, ray, position, now, before, news):
    """Pack each pixel's cell into an int32 and mark news.

    Offsets keep all numbers positive, so that truncation is the floor.
    """
    offset = narrow_offset(position)
    last = np.int32(NOTHING)
    for u in range(depths.size):
        key = narrow_key(depths[u], columns[u], ray, offset)
        now[u] = key
        news[u] = _is_new(key, last, before[u], before[u + 1])
        last = key


@cell
def narrow_offset(position):
    """Return the camera's position in cells, shifted to keep all cells within reach of an int32 key positive."""
    middle = np.float32(1 << (NARROW - 1))
    return position[0] + middle, position[1] + middle, position[2] + middle


@cell
def narrow_key(d, column, ray, offset):
    """Return the int32 key of the cell that holds the point at depth `d` of a pixel; NOTHING without a depth."""
    x = np.int32(d * (ray[0] * column + ray[1]) + offset[0])
    y = np.int32(d * (ray[2] * column + ray[3]) + offset[1])
    z = np.int32(d * (ray[4] * column + ray[5]) + offset[2])
    key = np.int32((x << np.int32(2 * NARROW)) | (y << np.int32(NARROW)) | z)
    return key if (d > ZERO) & (d < NO_RETURN) else np.int32(NOTHING)


@cell
def _wide_row(depths, columns, ray, position, now, before, news):
    """Pack each pixel's cell into an int64 and mark news."""
    last = np.int64(NOTHING)
    for u in range(depths.size):
        key = wide_key(depths[u], columns[u], ray, position)
        now[u] = key
        news[u] = _is_new(key, last, before[u], before[u + 1])
        last = key


@cell
def wide_key(d, column, ray, position):
    """Return the int64 key of the cell that holds the point at depth `d` of a pixel; NOTHING without a depth."""
    middle = np.int64(1 << (WIDE - 1))
    x, y, z = _point_cell(d, column, ray, position)
    key = ((np.int64(x) + middle) << (2 * WIDE)) | ((np.int64(y) + middle) << WIDE) | (np.int64(z) + middle)
    return key if (d > ZERO) & (d < NO_RETURN) else np.int64(NOTHING)


@cell
def _is_new(key, left, above, above_right):
    """Return whether a pixel holds a measurement in a cell that none of three earlier pixels has.

    Noise makes pixels of a surface near a cell's face alternate between two cells; these three comparisons pay off,
    further ones do not.
    """
    return np.uint8((key != left) & (key != above) & (key != above_right) & (key != NOTHING))


@cell
def _gather_news(news, fresh):
    """List the pixels with new cells; return how many. No unpredictable branches within a group."""
    groups = news.view(np.uint64)
    n = 0
    for group in range(groups.size):
        if groups[group] != 0:
            for u in range(GROUP * group, GROUP * group + GROUP):
                fresh[n] = u
                n += news[u]
    return n
