# SPDX-License-Identifier: Apache-2.0
"""Kernels of the sensor models: how well many poses explain one scan. Lengths in cells, in the frame of the grid."""

import numpy as np

from stereovox.kernels._jit import cell, kernel

ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
SAFE = np.float32(1.4143)
"""The distance of two points is less than that of their cells' centres by at most this diagonal."""
NUDGE, GROW = np.float32(1e-3), np.float32(1.000001)
"""A step across a cell's border, even far out, where float32 cannot resolve a thousandth."""
LEVEL, FAR = np.float32(1e-6), np.float32(1e9)


@kernel
def sum_at_ends(poses, ends, table, out):
    """Sum the table's values at the beam ends of each pose.

    poses: (N, 4) float32 column, row, cosine and sine of yaw; ends: (K, 2) float32 in the robot's frame; table: (rows,
    columns) float32, its border represents everything outside; out: (N,) float32.
    """
    bottom, right = np.float32(table.shape[0] - 1), np.float32(table.shape[1] - 1)
    for i in range(poses.shape[0]):
        x, y, cosine, sine = poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3]
        total = ZERO
        for j in range(ends.shape[0]):
            column = x + cosine * ends[j, 0] - sine * ends[j, 1]
            row = y + sine * ends[j, 0] + cosine * ends[j, 1]
            column = min(max(column, ZERO), right)
            row = min(max(row, ZERO), bottom)
            total += table[np.int32(row), np.int32(column)]
        out[i] = total


@kernel
def count_above(poses, ends, table, least, out):
    """Count, for each beam, the poses whose beam end has `least` or more in the table; arguments as above, out (K,)."""
    bottom, right = np.float32(table.shape[0] - 1), np.float32(table.shape[1] - 1)
    for j in range(ends.shape[0]):
        count = np.int32(0)
        for i in range(poses.shape[0]):
            column = poses[i, 0] + poses[i, 2] * ends[j, 0] - poses[i, 3] * ends[j, 1]
            row = poses[i, 1] + poses[i, 3] * ends[j, 0] + poses[i, 2] * ends[j, 1]
            column = min(max(column, ZERO), right)
            row = min(max(row, ZERO), bottom)
            count += np.int32(table[np.int32(row), np.int32(column)] >= least)
        out[j] = count


@kernel
def sum_of_casts(poses, origin, directions, clear, farthest, per_bin, table, out):
    """Sum the table's values for the expected length of each beam of each pose.

    poses: as above; origin: (2,) float32 of the sensor in the robot's frame; directions: (K, 2) float32, of length one;
    clear: (rows, columns) float32 cells to the nearest occupied one; farthest: (K,) float32, the longest length of each
    beam;
    per_bin: (K,) float32, bins of the table per cell of length; table: (K, bins) float32; out: (N,) float32.
    """
    last = np.int32(table.shape[1] - 1)
    for i in range(poses.shape[0]):
        x, y, cosine, sine = poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3]
        from_x = x + cosine * origin[0] - sine * origin[1]
        from_y = y + sine * origin[0] + cosine * origin[1]
        total = ZERO
        for j in range(directions.shape[0]):
            u = cosine * directions[j, 0] - sine * directions[j, 1]
            v = sine * directions[j, 0] + cosine * directions[j, 1]
            length = _cast(clear, from_x, from_y, u, v, farthest[j])
            total += table[j, min(np.int32(length * per_bin[j] + HALF), last)]
        out[i] = total


@kernel
def cast(clear, starts, directions, farthest, out):
    """Fill (N,) float32 `out` with the free length of rays from (N, 2) starts (column, row) along (N, 2) directions."""
    for i in range(starts.shape[0]):
        out[i] = _cast(clear, starts[i, 0], starts[i, 1], directions[i, 0], directions[i, 1], farthest)


@cell
def _cast(clear, x, y, u, v, farthest):
    """Return the length to the middle of a ray's segment in the first occupied cell, or `farthest`.

    Far from obstacles it leaps by the clear distance; near them it steps from cell to cell.
    """
    rows, columns = np.float32(clear.shape[0]), np.float32(clear.shape[1])
    to_right = ONE / u if abs(u) > LEVEL else FAR
    to_top = ONE / v if abs(v) > LEVEL else FAR
    ahead_x = ONE if u > -LEVEL else ZERO
    ahead_y = ONE if v > -LEVEL else ZERO
    way = ZERO
    while way < farthest:
        px, py = x + way * u, y + way * v
        if not ((px >= ZERO) & (py >= ZERO) & (px < columns) & (py < rows)):
            return farthest
        column, row = np.int32(px), np.int32(py)
        out_x = (np.float32(column) + ahead_x - x) * to_right
        out_y = (np.float32(row) + ahead_y - y) * to_top
        leaves = max(min(out_x, out_y), way)
        free = clear[row, column]
        if free == ZERO:
            return min((way + leaves) * HALF, farthest)
        way = max(leaves * GROW + NUDGE, way + free - SAFE)  # no branch: it would be hard to predict
    return farthest


@kernel
def join(indices, keys, round_, steps, parent):
    """Fill `parent` (K,) int64 with the index of the first bin of each bin's cluster.

    indices: (K, 3) int64 of different bins x, y, yaw, in order of their keys (K,) int64 (`particles.bin_keys`);
    round_: bins per full turn; steps: (M, 3) int64 to neighbours that belong together.
    """
    for i in range(keys.size):
        parent[i] = i
    for i in range(keys.size):
        for s in range(steps.shape[0]):
            x, y = indices[i, 0] + steps[s, 0], indices[i, 1] + steps[s, 1]
            turn = (indices[i, 2] + steps[s, 2] + round_) % round_
            key = ((x << 28) + y) * round_ + turn
            j = np.searchsorted(keys, key)
            if j < keys.size and keys[j] == key:
                a, b = _root(parent, i), _root(parent, j)
                parent[max(a, b)] = min(a, b)
    for i in range(keys.size):
        parent[i] = _root(parent, i)


@cell
def _root(parent, i):
    """Return the root of bin `i`'s cluster, with path compression."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
