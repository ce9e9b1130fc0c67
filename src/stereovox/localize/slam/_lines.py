# SPDX-License-Identifier: Apache-2.0
"""Kernels that turn the points of many scans into short lines, and a grid of the nearest line.

All coordinates are metres from the grid's corner. A slot is one cell that holds points; `index` holds its number.
"""

from __future__ import annotations

import numpy as np

from stereovox.kernels._jit import kernel

ZERO, HALF, ONE, TWO, FOUR = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2), np.float32(4)
TINY = np.float32(1e-12)
FEW = np.float32(2.5)
"""A line is fitted only to neighbourhoods with more points than this."""
ROUND = np.float32(0.12)
"""Ratio of the smaller to the larger variance above which a neighbourhood is no line."""


@kernel
def bounds(points, least, most):
    """Write the lowest and highest x, y of points (N, 2); leaves both unchanged if there are none."""
    for i in range(len(points)):
        for axis in range(2):
            value = points[i, axis]
            least[axis] = value if i == 0 else min(least[axis], value)
            most[axis] = value if i == 0 else max(most[axis], value)


@kernel
def gather(points, corner, views, cell, index, cells, sums):
    """Sum points (N, 2) and directions towards the sensor (N, 2) by cell; return how many slots there are.

    corner: (2,) float64 of the grid, in the points' frame.
    cells: (N, 2) int32 row, column; sums: (N, 8) float32 n, x, y, xx, xy, yy from the cell's middle, view x, view y.
    """
    count = 0
    rows, columns = index.shape
    for i in range(len(points)):
        x, y = np.float32(points[i, 0] - corner[0]), np.float32(points[i, 1] - corner[1])
        if not (x >= ZERO and y >= ZERO and x < cell * np.float32(columns) and y < cell * np.float32(rows)):
            continue
        row, column = min(int(y / cell), rows - 1), min(int(x / cell), columns - 1)
        slot = index[row, column]
        if slot < 0:
            slot = count
            index[row, column] = slot
            cells[slot, 0], cells[slot, 1] = row, column
            sums[slot] = ZERO
            count += 1
        dx = x - (np.float32(column) + HALF) * cell
        dy = y - (np.float32(row) + HALF) * cell
        sums[slot, 0] += ONE
        sums[slot, 1] += dx
        sums[slot, 2] += dy
        sums[slot, 3] += dx * dx
        sums[slot, 4] += dx * dy
        sums[slot, 5] += dy * dy
        sums[slot, 6] += views[i, 0]
        sums[slot, 7] += views[i, 1]
    return count


@kernel
def fit(index, cells, sums, cell, radius, fewest, lines):
    """Fit a line to the points around each slot that were seen from its side.

    radius: cells on each side. fewest: points of a neighbourhood below which it is not used.
    lines: (S, 8) float32: mean of the slot itself x, y; mean of its neighbourhood x, y; the line's normal towards the
    sensor x, y (for a mere point, that direction); 1 for a line, 0 for a mere point, -1 for too few points; 0.
    """
    rows, columns = index.shape
    for slot in range(len(lines)):
        row, column = cells[slot, 0], cells[slot, 1]
        vx, vy = sums[slot, 6], sums[slot, 7]
        n, x, y, xx, xy, yy = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
        for r in range(max(row - radius, 0), min(row + radius + 1, rows)):
            for c in range(max(column - radius, 0), min(column + radius + 1, columns)):
                other = index[r, c]
                if other < 0 or vx * sums[other, 6] + vy * sums[other, 7] < ZERO:
                    continue
                m, ox, oy = sums[other, 0], np.float32(c - column) * cell, np.float32(r - row) * cell
                sx, sy = sums[other, 1], sums[other, 2]
                n += m
                x += sx + m * ox
                y += sy + m * oy
                xx += sums[other, 3] + TWO * ox * sx + m * ox * ox
                xy += sums[other, 4] + ox * sy + oy * sx + m * ox * oy
                yy += sums[other, 5] + TWO * oy * sy + m * oy * oy
        x, y = x / n, y / n
        xx, xy, yy = xx / n - x * x, xy / n - x * y, yy / n - y * y
        spread = np.sqrt((xx - yy) * (xx - yy) + FOUR * xy * xy)
        large, small = HALF * (xx + yy + spread), max(HALF * (xx + yy - spread), ZERO)
        # The normal is the eigenvector of the smaller variance: turned by 90 degrees from the larger one's.
        angle = HALF * np.arctan2(TWO * xy, xx - yy)
        nx, ny = -np.sin(angle), np.cos(angle)
        if nx * vx + ny * vy < ZERO:
            nx, ny = -nx, -ny
        middle_x, middle_y = (np.float32(column) + HALF) * cell, (np.float32(row) + HALF) * cell
        lines[slot, 0] = middle_x + sums[slot, 1] / sums[slot, 0]
        lines[slot, 1] = middle_y + sums[slot, 2] / sums[slot, 0]
        lines[slot, 2], lines[slot, 3] = middle_x + x, middle_y + y
        lines[slot, 6] = ONE if n > FEW and small < ROUND * large else ZERO
        if lines[slot, 6] == ZERO:
            length = np.sqrt(vx * vx + vy * vy) + TINY
            nx, ny = vx / length, vy / length
        if n < fewest:
            lines[slot, 6] = -ONE
        lines[slot, 4], lines[slot, 5] = nx, ny
        lines[slot, 7] = ZERO


@kernel
def spread(cells, lines, cell, reach, sigma, near, score):
    """Write into every cell within `reach` cells of a slot the nearest slot, and a likelihood 1 / (1 + (d / sigma)^2).

    d: metres from the cell's middle to the mean of the slot's points; near: (rows, columns) int32, -1 if none;
    score: (rows, columns) float32, 0 if none.
    """
    rows, columns = near.shape
    narrow = ONE / (sigma * sigma)
    for slot in range(len(lines)):
        row, column = cells[slot, 0], cells[slot, 1]
        for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
            dy = (np.float32(r) + HALF) * cell - lines[slot, 1]
            for c in range(max(column - reach, 0), min(column + reach + 1, columns)):
                dx = (np.float32(c) + HALF) * cell - lines[slot, 0]
                likely = ONE / (ONE + (dx * dx + dy * dy) * narrow)
                if likely > score[r, c]:
                    score[r, c] = likely
                    near[r, c] = slot


@kernel
def wipe(cells, reach, index, near, score):
    """Clear only the cells that `gather` and `spread` wrote: a grid is large and mostly empty."""
    rows, columns = near.shape
    for slot in range(len(cells)):
        row, column = cells[slot, 0], cells[slot, 1]
        index[row, column] = -1
        for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for c in range(max(column - reach, 0), min(column + reach + 1, columns)):
                near[r, c] = -1
                score[r, c] = ZERO
