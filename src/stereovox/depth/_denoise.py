# SPDX-License-Identifier: Apache-2.0
"""Kernel that averages each pixel with the neighbours that noise cannot tell from it: along rows, then columns."""

import numpy as np

from stereovox._jit import cell, kernel

RADIUS = 3
"""Neighbours on each side. Written out below, so that a whole row of pixels is worked on at once."""
RING = 2 * RADIUS + 1
NONE = np.float32(-1e6)
"""Inverse depth of a pixel without value: far from every other."""
COARSEST = np.float32(1e4)
"""Bound for the noise of inverse depth, so that NONE stays far from everything."""
ZERO, ONE, THREE, FIVE, FAR = np.float32(0), np.float32(1), np.float32(3), np.float32(5), np.float32(np.inf)


@kernel
def denoise(depth_m, noise, fine, widths, low, high, line, ring):
    """Replace every depth by a weighted mean over neighbours, in place; pixels without value stay as they are.

    depth_m: (h, w) REP 117 depth image. noise: (3,) s0, s1, s2 of the depth noise in metres. fine: the noise in metres
    that does no harm. widths: (2,) how many sigma away a neighbour no longer counts, along rows and along columns.
    low, high: results are kept within these depths. line: (w + 2 RADIUS,) and ring: (RING, w), scratch.
    """
    height, width = depth_m.shape
    line[:] = NONE
    ring[:, :] = NONE
    for v in range(height + RADIUS):
        if v < height:
            _invert(depth_m[v], line[RADIUS : RADIUS + width])
            _along_row(line, noise, fine, widths[0], ring[v % RING])
        else:
            ring[v % RING, :] = NONE
        if v >= RADIUS:
            _along_columns(ring, v, noise, fine, widths[1], low, high, depth_m[v - RADIUS])


@cell
def _invert(depths, inverse):
    for u in range(depths.size):
        d = depths[u]
        inverse[u] = ONE / d if (d > ZERO) & (d < FAR) else NONE


@cell
def _along_row(line, noise, fine, wide, out):
    for u in range(out.size):
        c = line[u + 3]
        total, weight, wanted = _sums(
            c, line[u], line[u + 1], line[u + 2], line[u + 4], line[u + 5], line[u + 6], noise, fine, wide
        )
        out[u] = c + total / weight if wanted else c


@cell
def _along_columns(ring, v, noise, fine, wide, low, high, depths):
    """Average round the middle row of the ring, whose last row is `v`, and write depths where there were some."""
    a3, a2, a1, centre = ring[(v + 1) % RING], ring[(v + 2) % RING], ring[(v + 3) % RING], ring[(v + 4) % RING]
    b1, b2, b3 = ring[(v + 5) % RING], ring[(v + 6) % RING], ring[v % RING]
    for u in range(depths.size):
        c = centre[u]
        total, weight, wanted = _sums(c, a3[u], a2[u], a1[u], b1[u], b2[u], b3[u], noise, fine, wide)
        d = min(max(weight / (c * weight + total), low), high)
        depths[u] = d if wanted else depths[u]


@cell
def _sums(c, a3, a2, a1, b1, b2, b3, noise, fine, wide):
    """Return the weighted sum of differences from `c`, the sum of weights, and whether `c` is to change at all.

    A weight is (wide sigma)^2 - difference^2, not below 0. The farther neighbours count where noise is large.
    """
    sigma = min(noise[2] + c * (noise[1] + c * noise[0]), COARSEST)  # of inverse depth: sigma(z) / z^2
    square = (wide * sigma) * (wide * sigma)
    step = fine * c * c
    top1 = square if sigma > step else ZERO
    top2 = square if sigma > THREE * step else ZERO
    top3 = square if sigma > FIVE * step else ZERO
    p1, q1, p2, q2, p3, q3 = a1 - c, b1 - c, a2 - c, b2 - c, a3 - c, b3 - c
    f1, g1 = max(top1 - p1 * p1, ZERO), max(top1 - q1 * q1, ZERO)
    f2, g2 = max(top2 - p2 * p2, ZERO), max(top2 - q2 * q2, ZERO)
    f3, g3 = max(top3 - p3 * p3, ZERO), max(top3 - q3 * q3, ZERO)
    total = (f1 * p1 + g1 * q1) + (f2 * p2 + g2 * q2) + (f3 * p3 + g3 * q3)
    return total, square + ((f1 + g1) + (f2 + g2) + (f3 + g3)), (sigma > step) & (c > ZERO)
