# SPDX-License-Identifier: Apache-2.0
"""Kernel that counts which depths lie on surfaces."""

import numpy as np

from stereovox._jit import kernel

ONE, TWO, ZERO = np.float32(1), np.float32(2), np.float32(0)
FAR = np.float32(np.inf)


@kernel
def surfaces(depth_m, step, noise, slack, counts):
    """Write to `counts` (2,) int64 of how many pixels both neighbours in the row have a depth, and how many are even.

    depth_m: (height, width) float32, REP 117; every `step`-th row is looked at. noise: (3,) s0, s1, s2 of the range
    noise, times what a second difference may be in sigma. slack: share of the inverse depth that it may be on top.
    """
    compared, even = np.int64(0), np.int64(0)
    for v in range(0, depth_m.shape[0], step):
        for u in range(1, depth_m.shape[1] - 1):
            a, b, c = depth_m[v, u - 1], depth_m[v, u], depth_m[v, u + 1]
            if (a > ZERO) & (b > ZERO) & (c > ZERO) & (a < FAR) & (b < FAR) & (c < FAR):
                middle = ONE / b
                bend = abs(ONE / a - TWO * middle + ONE / c)
                allowed = (noise[0] * middle + noise[1] + slack) * middle + noise[2]
                compared += 1
                even += bend <= allowed
    counts[0], counts[1] = compared, even
