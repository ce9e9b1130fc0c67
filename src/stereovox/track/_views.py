# SPDX-License-Identifier: Apache-2.0
"""Kernels that compare points with the depth grid of another image."""

import numpy as np

from stereovox.kernels._jit import cell, kernel

NEAREST = 0.05
"""Depth in metres before which nothing is seen."""


@kernel
def stood_free(points, sigma, R, t, slope, nearest, deviations, tolerance, free):
    """Set `free` (N,) bool for points inside the free space of a view.

    points (N, 3), sigma (N,): float32. R (3, 3), t (3,): into the view's camera. slope (2,), nearest (rows, columns):
    of the view. Slack: `deviations` times sigma plus `tolerance` times the view's depth.
    """
    for i in range(points.shape[0]):
        row, column, z = _place(points, i, R, t, slope, nearest.shape)
        if row >= 0:
            seen = nearest[row, column]
            if np.isfinite(seen) and z < seen - (deviations * sigma[i] + tolerance * seen):
                free[i] = True


@kernel
def seen_through(points, sigma, R, t, slope, depth, deviations, tolerance, step, found):
    """Count, of every `step`th point, those the view looks through (found[0]) and those it confirms (found[1]).

    depth: (rows, columns) of the view, NaN if it has none; the rest as in `stood_free`.
    """
    found[0] = found[1] = 0
    for i in range(0, points.shape[0], step):
        row, column, z = _place(points, i, R, t, slope, depth.shape)
        if row < 0 or not np.isfinite(depth[row, column]):
            continue
        seen = depth[row, column]
        slack = deviations * sigma[i] + tolerance * seen
        if z < seen - slack:
            found[0] += 1
        elif abs(z - seen) <= slack:
            found[1] += 1


@cell
def _place(points, i, R, t, slope, shape):
    """Return row and column of a point in a view's grid, -1 if it is not in it, and its depth there."""
    x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
    a = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + t[0]
    b = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + t[1]
    c = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + t[2]
    if not c > NEAREST:
        return -1, -1, c
    column = np.int64(np.floor((a / c / slope[0] + 1) / 2 * shape[1]))
    row = np.int64(np.floor((b / c / slope[1] + 1) / 2 * shape[0]))
    if row < 0 or column < 0 or row >= shape[0] or column >= shape[1]:
        return -1, -1, c
    return row, column, c
