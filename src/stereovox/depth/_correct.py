# SPDX-License-Identifier: Apache-2.0
"""Kernels that correct metres by what a calibration found."""

import numpy as np

from stereovox._jit import kernel

NAN, ZERO, ONE, INF = np.float32(np.nan), np.float32(0), np.float32(1), np.float32(np.inf)


@kernel
def quadratics(s, q, x, y, depth_m):
    """Divide `depth_m` (rows, columns) in place by 1 + s(x, y) + q(x, y) z; NaN: that is no depth; infinities stay.

    s, q: (6,) float32, coefficients of 1, x, y, x^2, x y, y^2. x, y: slopes of columns and rows.
    """
    for v in range(y.size):
        b = y[v]
        s0, q0 = s[0] + b * (s[2] + b * s[5]), q[0] + b * (q[2] + b * q[5])
        s1, q1 = s[1] + b * s[4], q[1] + b * q[4]
        row = depth_m[v]
        for u in range(x.size):
            a, z = x[u], row[u]
            divisor = ONE + s0 + a * (s1 + a * s[3]) + (q0 + a * (q1 + a * q[3])) * z
            d = z / divisor if divisor > ZERO else NAN
            row[u] = z if abs(z) == INF else d


@kernel
def thesis(p, x, depth_m):
    """Take p1 X^2 + p2 X + p3 with X = x z off `depth_m` (rows, columns) in place (Chien 2020, Eq A.3)."""
    for v in range(depth_m.shape[0]):
        row = depth_m[v]
        for u in range(x.size):
            z = row[u]
            across = x[u] * z
            d = z - (across * (p[0] * across + p[1]) + p[2])
            d = d if d > ZERO else NAN
            row[u] = z if abs(z) == INF else d
