# SPDX-License-Identifier: Apache-2.0
"""Kernels for glances: bin ranges by direction, and compare the points of another glance with them."""

import numpy as np

from stereovox.kernels._jit import cell, kernel

SIDE = 128
"""Directions are binned in an unfolded octahedron (Meyer et al. 2010), SIDE by SIDE bins of about 1.6 degrees."""
UNSEEN, SAME, ELSEWHERE = (np.uint8(n) for n in range(3))
"""Where a point is: in a direction without ranges; at one of them, or on the surface through them; before or behind
all of them, or between two."""
SURFACE = np.float32(0.3)
"""Share of its distance by which a surface seen at a flat angle may extend from bin to bin."""
HALF, ONE, LEAST = np.float32(0.5), np.float32(1), np.float32(1e-9)
NONE, FAR = np.float32(0), np.float32(np.inf)


@cell
def _sides(x, y, z):
    """Return the row and column of the bin of a direction; +z is in the middle of the square."""
    length = max(abs(x) + abs(y) + abs(z), LEAST)
    x, y = x / length, y / length
    a = (ONE - abs(y)) * (-ONE if x < NONE else ONE) if z < NONE else x
    b = (ONE - abs(x)) * (-ONE if y < NONE else ONE) if z < NONE else y
    row, column = np.int32((b + ONE) * HALF * SIDE), np.int32((a + ONE) * HALF * SIDE)
    return min(max(row, np.int32(0)), np.int32(SIDE - 1)), min(max(column, np.int32(0)), np.int32(SIDE - 1))


@cell
def _place(ranges, x, y, z, tolerance):
    """Return where a point is among `ranges`, as one of the constants above; its bin and the neighbours count."""
    row, column = _sides(x, y, z)
    far = np.sqrt(x * x + y * y + z * z)
    if ranges[row, column] == NONE:
        return UNSEEN  # at the edge of the view, the neighbours are on one side only
    nearest, farthest, least = FAR, NONE, FAR
    for v in range(max(row - 1, 0), min(row + 2, SIDE)):
        for u in range(max(column - 1, 0), min(column + 2, SIDE)):
            found = ranges[v, u]
            if found > NONE:
                nearest, farthest, least = min(nearest, found), max(farthest, found), min(least, abs(found - far))
    if far < nearest - tolerance or far > farthest + tolerance:
        return ELSEWHERE
    return SAME if least <= tolerance or farthest - nearest <= SURFACE * far else ELSEWHERE


@kernel
def bin_points(points, ranges):
    """Write the distances of `points` (N, 3) to their bins of `ranges` (SIDE, SIDE); the last one in a bin wins."""
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        row, column = _sides(x, y, z)
        ranges[row, column] = np.sqrt(x * x + y * y + z * z)


@kernel
def place(ranges, points, T, tolerance, out):
    """Write to `out` (N,) uint8 where points (N, 3) are among `ranges` (SIDE, SIDE) in metres, 0 for none.

    T: (3, 4) from the points' frame to that of the ranges. tolerance: (N,) metres.
    """
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        out[i] = _place(
            ranges,
            T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
            T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
            T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3],
            tolerance[i],
        )


@kernel
def bin_image(depth_m, columns, rows, first, step, reach, ranges):
    """Write the distance of every `step`-th pixel from `first` to its bin, if it is at most `reach` metres.

    depth_m: (height, width) metres. columns: (width,), rows: (height, 2) rays of the pixels.
    """
    for v in range(first, depth_m.shape[0], step):
        for u in range(first, depth_m.shape[1], step):
            depth = depth_m[v, u]
            x, y, z = columns[u] * depth, rows[v, 0] * depth, rows[v, 1] * depth
            far = np.sqrt(x * x + y * y + z * z)
            if far > NONE and far <= reach:
                row, column = _sides(x, y, z)
                ranges[row, column] = far
