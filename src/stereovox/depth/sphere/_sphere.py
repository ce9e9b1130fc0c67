# SPDX-License-Identifier: Apache-2.0
"""Kernels that gather points in the cells of a spherical grid (Valenti 2018, 5.3)."""

import numpy as np

from stereovox.kernels._jit import cell, kernel

VALID, TOO_NEAR, TOO_FAR = np.uint8(0), np.uint8(2), np.uint8(3)
ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
PI, HALF_PI = np.float32(np.pi), np.float32(np.pi / 2)
TINY = np.float32(1e-30)
A1, A3, A5 = np.float32(0.99997726), np.float32(-0.33262347), np.float32(0.19354346)
A7, A9, A11 = np.float32(-0.11643287), np.float32(0.05265332), np.float32(-0.01172120)


@kernel
def gather_image(depth_m, reason, columns, rows, pose, near, far, layout, cells, scratch):
    """Put the pixels of a REP 117 depth image (height, width) into the cells of a grid.

    columns, rows: `camera.rays()`; pose: (3, 4) float32, maps the optical frame into the grid's. A pixel that is
    TOO_FAR counts as a point at depth `far`, up to which its ray is free; one that is TOO_NEAR as a point at `near`.
    scratch: (2, width) float32.
    """
    width = depth_m.shape[1]
    ranges, places = scratch[0], scratch[1].view(np.int32)
    for v in range(depth_m.shape[0]):
        down, ahead = rows[v, 0], rows[v, 1]
        ax, ay, az = pose[0, 0], pose[1, 0], pose[2, 0]
        bx = pose[0, 1] * down + pose[0, 2] * ahead
        by = pose[1, 1] * down + pose[1, 2] * ahead
        bz = pose[2, 1] * down + pose[2, 2] * ahead
        for u in range(width):
            why = reason[v, u]
            d = depth_m[v, u] if why == VALID else (far if why == TOO_FAR else near)
            x = d * (ax * columns[u] + bx) + pose[0, 3]
            y = d * (ay * columns[u] + by) + pose[1, 3]
            z = d * (az * columns[u] + bz) + pose[2, 3]
            ranges[u] = np.sqrt(x * x + y * y + z * z)
            places[u] = _place(x, y, z, layout)
        for u in range(width):
            why = reason[v, u]
            if (places[u] >= 0) & ((why == VALID) | (why == TOO_NEAR) | (why == TOO_FAR)):
                _add(places[u], ranges[u], why, cells)


@kernel
def gather_points(points, reason, layout, cells):
    """Put points (N, 3) float32 of the grid's frame into its cells; `reason` (N,) is as for pixels."""
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        place = _place(x, y, z, layout)
        why = reason[i]
        if (place >= 0) & ((why == VALID) | (why == TOO_NEAR) | (why == TOO_FAR)):
            _add(place, np.sqrt(x * x + y * y + z * z), why, cells)


@cell
def _place(x, y, z, layout):
    """Return the number of the cell that contains a direction, -1 outside the grid (Valenti 2018, Eq 5.2)."""
    polar = _arctan2(np.sqrt(x * x + y * y), z)
    azimuth = _arctan2(y, x)
    j = np.int32(min(polar * layout.per_radian, np.float32(layout.half_turn - 1))) - layout.first_polar
    i = np.int32((azimuth + PI) * layout.per_radian) - layout.first_azimuth
    i -= layout.turn if i >= layout.turn else np.int32(0)
    i += layout.turn if i < 0 else np.int32(0)
    inside = (i < layout.azimuths) & (j >= 0) & (j < layout.polars)
    return i * layout.polars + j if inside else np.int32(-1)


@cell
def _arctan2(y, x):
    """Return the angle, correct to 2e-6, without branches."""
    ax, ay = abs(x), abs(y)
    t = min(ax, ay) / max(max(ax, ay), TINY)
    s = t * t
    angle = t * (A1 + s * (A3 + s * (A5 + s * (A7 + s * (A9 + s * A11)))))
    angle = HALF_PI - angle if ay > ax else angle
    angle = PI - angle if x < ZERO else angle
    return -angle if y < ZERO else angle


@cell
def _add(place, rho, why, cells):
    """Add one point to the statistics of its cell; Welford's mean and squares are accurate enough in float32."""
    if why == VALID:
        n = cells.number[place] + np.int32(1)
        away = rho - cells.mean[place]
        mean = cells.mean[place] + away / np.float32(n)
        cells.number[place] = n
        cells.mean[place] = mean
        cells.squares[place] += away * (rho - mean)
        cells.nearest[place] = min(cells.nearest[place], rho)
    elif why == TOO_FAR:
        cells.free_to[place] = min(cells.free_to[place], rho)
    else:
        cells.too_near[place] = np.uint8(1)
