# SPDX-License-Identifier: Apache-2.0
"""Kernel that sums the constraints of landmarks on the pose of the camera that sees them.

Kernel that projects a depth image into the cells of another camera's image. Kernels that compare points with the depth
grid of another image.
"""

from __future__ import annotations

import numpy as np

from stereovox.kernels._jit import cell, kernel


@kernel
def equations(
    centre, ray, inverse, variance, measured, deviation, lens, R, t, pixel, alike, reach, work, information, gradient
):
    """Fill the normal equations of a small motion (rotation about the camera, then shift, in the map's axes).

    The residuals of `sightings.Sightings.residuals`, weighted by their inverse covariance, by `alike` and by Geman and
    McClure's function of `reach` squared deviations. All float64.

    centre, ray (N, 3), inverse, variance (N,): the landmarks. measured (N, 3), deviation (N,): where they are found.
    lens (4,): fx, fy, cx, cy. R (3, 3), t (3,): T_world_camera. pixel: standard deviation of a corner's position.
    Written: work (6, 3, 6), information (6, 6), gradient (6,).
    """
    information[:], gradient[:] = 0.0, 0.0
    fx, fy, cx, cy = lens
    work[0] = 0.0
    by_place, by_world, by_motion, weighted = work[0], work[1], work[2], work[3]
    arm, q, off, by_inverse, scaled, own = work[4, 0], work[4, 1], work[4, 2], work[5, 0], work[5, 1], work[5, 2]
    own[0], own[1] = 2 * pixel * pixel, 2 * pixel * pixel
    for i in range(inverse.shape[0]):
        rho = inverse[i]
        for k in range(3):
            arm[k] = centre[i, k] - t[k]
            q[k] = rho * arm[k] + ray[i, k]
        x = q[0] * R[0, 0] + q[1] * R[1, 0] + q[2] * R[2, 0]
        y = q[0] * R[0, 1] + q[1] * R[1, 1] + q[2] * R[2, 1]
        z = max(q[0] * R[0, 2] + q[1] * R[1, 2] + q[2] * R[2, 2], 1e-3)
        off[0] = measured[i, 0] - (fx * x / z + cx)
        off[1] = measured[i, 1] - (fy * y / z + cy)
        off[2] = measured[i, 2] - rho / z
        by_place[0, 0], by_place[0, 2] = fx / z, -fx * x / z**2
        by_place[1, 1], by_place[1, 2] = fy / z, -fy * y / z**2
        by_place[2, 2] = -rho / z**2
        spread = 0.0  # of the landmark's own distance, in measurement variances
        for j in range(3):
            for k in range(3):
                by_world[j, k] = by_place[j, 0] * R[k, 0] + by_place[j, 1] * R[k, 1] + by_place[j, 2] * R[k, 2]
            w0, w1, w2 = by_world[j, 0], by_world[j, 1], by_world[j, 2]
            by_motion[j, 0], by_motion[j, 1] = w1 * q[2] - w2 * q[1], w2 * q[0] - w0 * q[2]
            by_motion[j, 2] = w0 * q[1] - w1 * q[0]
            by_motion[j, 3], by_motion[j, 4], by_motion[j, 5] = -rho * w0, -rho * w1, -rho * w2
            by_inverse[j] = w0 * arm[0] + w1 * arm[1] + w2 * arm[2]
        by_inverse[2] += 1 / z
        own[2] = deviation[i] * deviation[i]
        for j in range(3):
            scaled[j] = by_inverse[j] / own[j]
            spread += by_inverse[j] * scaled[j]
        share = variance[i] / (1 + variance[i] * spread)  # Sherman and Morrison 1950
        squares, along = 0.0, 0.0
        for j in range(3):
            along += scaled[j] * off[j]
        for j in range(3):
            squares += off[j] * off[j] / own[j]
        squares -= share * along * along
        weight = 1 / (alike * (1 + squares / reach) ** 2)
        for k in range(6):
            common = 0.0
            for j in range(3):
                common += scaled[j] * by_motion[j, k]
            for j in range(3):
                weighted[j, k] = weight * (by_motion[j, k] / own[j] - share * scaled[j] * common)
        for k in range(6):
            for j in range(3):
                gradient[k] += weighted[j, k] * off[j]
                for m in range(6):
                    information[k, m] += weighted[j, k] * by_motion[j, m]


ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)


@kernel
def laid_into(depth_m, columns, rows, R, t, lens, cell_px, step, total, number):
    """Sum, per cell of another camera's image, the inverse depths of every `step`th pixel of a depth image.

    depth_m: (H, W) REP 117. columns (W,), rows (H, 2): rays; depth times (columns, rows) is the point. R (3, 3), t
    (3,): into the other camera's frame. lens (4,): its fx, fy, cx, cy. cell_px: size of a cell in its pixels. Written,
    both (h, w): the sum, and the number of pixels in a cell.
    """
    for v in range(step // 2, depth_m.shape[0], step):
        for u in range(step // 2, depth_m.shape[1], step):
            depth = depth_m[v, u]
            if not (np.isfinite(depth) and depth > ZERO):
                continue
            a, b, c = columns[u] * depth, rows[v, 0] * depth, rows[v, 1] * depth
            z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
            if not z > ZERO:
                continue
            inverse = ONE / z
            x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]
            y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]
            column = (lens[0] * x * inverse + lens[2] + HALF) / cell_px
            row = (lens[1] * y * inverse + lens[3] + HALF) / cell_px
            if column >= ZERO and row >= ZERO and column < total.shape[1] and row < total.shape[0]:
                i, j = np.int64(row), np.int64(column)
                total[i, j] += inverse
                number[i, j] += ONE


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
