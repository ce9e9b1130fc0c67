# SPDX-License-Identifier: Apache-2.0
"""Kernels that register a scan to a map of lines: a search over a window, then Gauss-Newton.

Our own, because libraries register 3-D point clouds (small_gicp); a floor's scans need lines and three unknowns. Poses
and sums are float64 here: solving the 3 x 3 normal matrix loses half of the digits.
"""

from __future__ import annotations

import numpy as np

from stereovox.kernels._jit import allocating_kernel, cell

ZERO, ONE = np.float32(0), np.float32(1)
FACING = np.float32(0.05)
"""Cosine between a line's normal and the direction towards the sensor, below which its other side was seen."""


@allocating_kernel
def search(points, guess, score, cell, side, side_yaw, step_yaw, slope, slope_yaw, best):
    """Try all poses within `side` cells and `side_yaw` steps of the guess; return the likelihood of the best.

    points: (N, 2) float32 in the robot's frame. guess, best: (3,) float64 x, y, yaw in the grid's frame; best is
    written. score: (rows, columns) float32. Likelihood: the mean score of the points, less `slope` per squared metre
    and `slope_yaw` per squared radian away from the guess (Olson 2009; ties: the first).
    """
    rows, columns = score.shape
    turned = np.empty((len(points), 2), np.int32)
    top = -1e30
    inverse = ONE / cell
    for k in range(-side_yaw, side_yaw + 1):
        yaw = guess[2] + k * step_yaw
        cosine, sine = np.float32(np.cos(yaw)), np.float32(np.sin(yaw))
        x0, y0 = np.float32(guess[0]), np.float32(guess[1])
        for i in range(len(points)):
            x = x0 + cosine * points[i, 0] - sine * points[i, 1]
            y = y0 + sine * points[i, 0] + cosine * points[i, 1]
            turned[i, 0] = np.int32(np.floor(y * inverse))
            turned[i, 1] = np.int32(np.floor(x * inverse))
        for dr in range(-side, side + 1):
            for dc in range(-side, side + 1):
                total = ZERO
                for i in range(len(points)):
                    row, column = turned[i, 0] + dr, turned[i, 1] + dc
                    if row >= 0 and column >= 0 and row < rows and column < columns:
                        total += score[row, column]
                away = (dr * dr + dc * dc) * cell * cell
                likely = total / max(len(points), 1) - slope * away - slope_yaw * (k * step_yaw) ** 2
                if likely > top:
                    top = likely
                    best[0] = guess[0] + dc * cell
                    best[1] = guess[1] + dr * cell
                    best[2] = yaw
    return top


@cell
def _on_line(dx, dy, ax, ay, nx, ny, narrow, normal, gradient):
    """Add the constraint of a point off a line by dx, dy; return its squared distance to the line and its weight.

    ax, ay: from the robot to the point. nx, ny: the line's normal.
    """
    r = nx * dx + ny * dy
    w = 1.0 / (1.0 + r * r * narrow)
    w *= w
    jt = -nx * ay + ny * ax
    normal[0, 0] += w * nx * nx
    normal[0, 1] += w * nx * ny
    normal[1, 1] += w * ny * ny
    normal[0, 2] += w * nx * jt
    normal[1, 2] += w * ny * jt
    normal[2, 2] += w * jt * jt
    gradient[0] += w * nx * r
    gradient[1] += w * ny * r
    gradient[2] += w * jt * r
    return r * r, w


@cell
def _at_point(dx, dy, ax, ay, point_weight, narrow, normal, gradient):
    """Add the constraint of a point off another by dx, dy; return their squared distance and its weight."""
    square = dx * dx + dy * dy
    w = 1.0 / (1.0 + square * narrow)
    w *= w * point_weight
    normal[0, 0] += w
    normal[1, 1] += w
    normal[0, 2] += -w * ay
    normal[1, 2] += w * ax
    normal[2, 2] += w * (ax * ax + ay * ay)
    gradient[0] += w * dx
    gradient[1] += w * dy
    gradient[2] += w * (ax * dy - ay * dx)
    return square, w


@allocating_kernel
def refine(points, views, near, lines, cell, sigma, point_weight, prior, information, iterations, pose, normal, cost):
    """Refine `pose` (3,) so that points lie on lines, near `prior`; return how many points are on lines.

    Least squares of the distances over `sigma` metres with Geman and McClure's weights, plus the prior's `information`
    (3, 3). A point counts if a line seen from the same side is near; at corners without a line both coordinates count,
    times `point_weight`.
    normal: (3, 3), written: information of the points alone, for x, y, yaw in the grid's frame.
    cost: (2,), written: the weighted mean of the squared distances in m^2, and the sum of weights.
    """
    rows, columns = near.shape
    inverse = 1.0 / cell
    gradient = np.empty(3)
    narrow = 1.0 / (sigma * sigma)
    on = 0
    for _ in range(iterations):
        cosine, sine = np.cos(pose[2]), np.sin(pose[2])
        normal[:] = 0.0
        gradient[:] = 0.0
        on = 0
        squares, weights = 0.0, 0.0
        for i in range(len(points)):
            ax = cosine * points[i, 0] - sine * points[i, 1]
            ay = sine * points[i, 0] + cosine * points[i, 1]
            x, y = pose[0] + ax, pose[1] + ay
            row, column = int(np.floor(y * inverse)), int(np.floor(x * inverse))
            if row < 0 or column < 0 or row >= rows or column >= columns:
                continue
            slot = near[row, column]
            if slot < 0 or lines[slot, 6] < ZERO:
                continue
            nx, ny = lines[slot, 4], lines[slot, 5]
            vx = cosine * views[i, 0] - sine * views[i, 1]
            vy = sine * views[i, 0] + cosine * views[i, 1]
            if nx * vx + ny * vy < FACING:
                continue
            if lines[slot, 6] > ZERO:
                square, w = _on_line(x - lines[slot, 2], y - lines[slot, 3], ax, ay, nx, ny, narrow, normal, gradient)
            else:
                dx, dy = x - lines[slot, 0], y - lines[slot, 1]
                square, w = _at_point(dx, dy, ax, ay, point_weight, narrow, normal, gradient)
            squares += w * square
            weights += w
            if square < sigma * sigma:
                on += 1
        for a in range(3):
            for b in range(a):
                normal[a, b] = normal[b, a]
        normal *= narrow
        gradient *= narrow
        cost[0], cost[1] = squares / max(weights, 1e-9), weights
        step = _step(normal, information, gradient, pose, prior)
        pose[0] += step[0]
        pose[1] += step[1]
        pose[2] += step[2]
        if abs(step[0]) + abs(step[1]) < 1e-5 and abs(step[2]) < 1e-6:
            break
    return on


@allocating_kernel
def _step(normal, information, gradient, pose, prior):
    a = normal + information
    off = pose - prior
    off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
    b = gradient.copy()
    for i in range(3):
        for k in range(3):
            b[i] += information[i, k] * off[k]
        a[i, i] += 1e-9
    # Cholesky by hand: three unknowns.
    l00 = np.sqrt(a[0, 0])
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    l11 = np.sqrt(max(a[1, 1] - l10 * l10, 1e-12))
    l21 = (a[2, 1] - l20 * l10) / l11
    l22 = np.sqrt(max(a[2, 2] - l20 * l20 - l21 * l21, 1e-12))
    y0 = -b[0] / l00
    y1 = (-b[1] - l10 * y0) / l11
    y2 = (-b[2] - l20 * y0 - l21 * y1) / l22
    b[2] = y2 / l22
    b[1] = (y1 - l21 * b[2]) / l11
    b[0] = (y0 - l10 * b[1] - l20 * b[2]) / l00
    return b
