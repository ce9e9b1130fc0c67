# SPDX-License-Identifier: Apache-2.0
"""Kernel that projects a depth image into the cells of another camera's image."""

import numpy as np

from stereovox.kernels._jit import kernel

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
