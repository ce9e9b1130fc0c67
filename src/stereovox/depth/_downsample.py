# SPDX-License-Identifier: Apache-2.0
"""Kernel of the block minimum."""

import numpy as np

from stereovox._jit import cell, kernel

UNMATCHED, TOO_NEAR, TOO_FAR, MASKED, UNKNOWN = np.uint8(1), np.uint8(2), np.uint8(3), np.uint8(4), np.uint8(5)
NAN, NEAR, FAR = np.float32(np.nan), np.float32(-np.inf), np.float32(np.inf)
ZERO = np.float32(0)


@kernel
def block_minimum(depth_m, reason, n, row, out_depth, out_reason):
    """Fill `out_depth` and `out_reason` (h / n, w / n, rounded up) from a REP 117 image (h, w) and its reasons.

    row: (w,) float32 scratch for the smallest valid depth of each column of a row of blocks.
    """
    height, width = depth_m.shape
    for i in range(out_depth.shape[0]):
        first, last = i * n, min((i + 1) * n, height)
        row[:] = FAR
        for v in range(first, last):  # whole rows, so that the compiler can take many columns at once
            for u in range(width):
                d = depth_m[v, u]
                row[u] = d if (d > ZERO) & (d < row[u]) else row[u]
        for j in range(out_depth.shape[1]):
            left, right = j * n, min((j + 1) * n, width)
            nearest = FAR
            for u in range(left, right):
                nearest = min(nearest, row[u])
            why = np.uint8(0) if nearest < FAR else _why(reason, first, last, left, right)
            without = NEAR if why == TOO_NEAR else (FAR if why == TOO_FAR else NAN)
            out_depth[i, j] = nearest if why == 0 else without
            out_reason[i, j] = why


@cell
def _why(reason, first, last, left, right):
    """Return the reason of a block without a valid pixel."""
    far, masked, unmatched = True, False, False
    for v in range(first, last):
        for u in range(left, right):
            why = reason[v, u]
            if why == TOO_NEAR:
                return TOO_NEAR
            far = far and why == TOO_FAR
            masked = masked or why == MASKED
            unmatched = unmatched or why == UNMATCHED
    return TOO_FAR if far else (MASKED if masked else (UNMATCHED if unmatched else UNKNOWN))
