# SPDX-License-Identifier: Apache-2.0
"""Kernels for clouds: select usable rays, find the nearest neighbours of some of them."""

import numpy as np

from stereovox.kernels._jit import kernel


@kernel
def usable(points, origins, range_min, range_max, reach, ends, starts, hits):
    """Write the usable rays of points (N, 3) without gaps; return their number, and the number of finite points.

    origins: (N, 3) where each was measured from, (0, 3): all from the sensor. A point at 0, 0, 0 is no point. Output,
    (N,
    3) each and (N,): where rays end and begin, and whether at a surface: beyond `range_max` they end there without one,
    at least `reach` in front of the point, whose noise that allows for.
    """
    used = finite = 0
    moving = origins.shape[0] > 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if x == 0 and y == 0 and z == 0:
            continue
        a, b, c = (origins[i, 0], origins[i, 1], origins[i, 2]) if moving else (0.0, 0.0, 0.0)
        dx, dy, dz = x - a, y - b, z - c
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if not np.isfinite(length):
            continue
        finite += 1
        if not length >= range_min:
            continue
        far = length > range_max
        share = max(min(length - reach, range_max), 0.0) / length if far else 1.0
        ends[used, 0] = a + dx * share if far else x
        ends[used, 1] = b + dy * share if far else y
        ends[used, 2] = c + dz * share if far else z
        starts[used, 0], starts[used, 1], starts[used, 2] = a, b, c
        hits[used] = not far
        used += 1
    return used, finite


@kernel
def nearest(directions, asked, found):
    """Fill `found` (Q,) with the column of the unit vector nearest to each of `asked`, other than itself.

    directions: (3, N) float32; asked: (Q,) int64 columns of it.
    """
    x, y, z = directions[0], directions[1], directions[2]
    for q in range(asked.size):
        i = asked[q]
        a, b, c = x[i], y[i], z[i]
        least, at = np.float32(np.inf), np.int64(-1)
        for j in range(x.size):
            dx, dy, dz = x[j] - a, y[j] - b, z[j] - c
            square = dx * dx + dy * dy + dz * dz
            if square < least and j != i:
                least, at = square, j
        found[q] = at
