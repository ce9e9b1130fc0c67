# SPDX-License-Identifier: Apache-2.0
"""Kernel that counts which pixels say something, and which depths lie on surfaces."""

import numpy as np

from stereovox._jit import kernel

ONE, TWO, ZERO = np.float32(1), np.float32(2), np.float32(0)
FAR = np.float32(np.inf)


@kernel
def count(depth_m, step, noise, slack, counts):
    """Write to `counts` (4,) int64 how many pixels are looked at, and how many of them say something; of how many both
    neighbours in the row have a depth as well, and how many of these lie on a surface with them.

    depth_m: (height, width) float32, REP 117; every `step`-th row is looked at. noise: (3,) s0, s1, s2 of the range
    noise, times what a second difference may be in sigma. slack: share of the inverse depth that it may be on top.
    """
    looked, saying, compared, even = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for v in range(0, depth_m.shape[0], step):
        row = depth_m[v]
        looked += row.size
        for u in range(row.size):
            saying += row[u] > ZERO
        for u in range(1, row.size - 1):
            a, b, c = row[u - 1], row[u], row[u + 1]
            both = (a > ZERO) & (b > ZERO) & (c > ZERO) & (a < FAR) & (b < FAR) & (c < FAR)
            middle = ONE / b
            bend = abs(ONE / a - TWO * middle + ONE / c)
            allowed = (noise[0] * middle + noise[1] + slack) * middle + noise[2]
            compared += both
            even += both & (bend <= allowed)
    counts[0], counts[1], counts[2], counts[3] = looked, saying, compared, even
