# SPDX-License-Identifier: Apache-2.0
"""Kernel that averages each pixel with the like neighbours in its row and its column, twice."""

import numpy as np

from stereovox._jit import cell, kernel

RADIUS = 3
"""Neighbours on each side. Written out below, so that a whole row of pixels is worked on at once."""
RING = 2 * RADIUS + 1
SEGMENT = 64
"""Pixels of a row that share the number of neighbours looked at: that of the farthest of them."""
NONE = np.float32(-1e6)
"""Inverse depth of a pixel without value: far from every other."""
COARSEST = np.float32(1e4)
"""Bound for the noise of inverse depth, so that NONE stays far from everything."""
ZERO, ONE, THREE, FIVE, FAR = np.float32(0), np.float32(1), np.float32(3), np.float32(5), np.float32(np.inf)


@kernel
def denoise(depth_m, noise, fine, widths, limit, low, high, raw, once):
    """Replace every depth by a weighted mean over neighbours, in place; pixels without value stay as they are.

    depth_m: (h, w) REP 117 depth image. noise: (3,) s0, s1, s2 of the depth noise in metres. fine: the noise in metres
    that does no harm. widths: (2,) how many sigma away a neighbour no longer counts, in the first and the second pass;
    limit: the same in metres, where that is less. low, high: results are kept within these depths. raw, once: scratch,
    (RING, w + 2 RADIUS), inverse depths of the rows that are needed: measured, and after the first pass.
    """
    height = depth_m.shape[0]
    raw[:, :] = NONE
    once[:, :] = NONE
    for v in range(height + 2 * RADIUS):
        if v < height:
            _invert(depth_m[v], raw[v % RING])
        else:
            raw[v % RING, :] = NONE
        if RADIUS <= v < height + RADIUS:
            _average(raw, v, noise, fine, widths[0], limit, once[(v - RADIUS) % RING])
        elif v >= height + RADIUS:
            once[(v - RADIUS) % RING, :] = NONE
        if v >= 2 * RADIUS:
            row = raw[(v - 2 * RADIUS) % RING]  # measured depths of this row are needed no more
            _average(once, v - RADIUS, noise, fine, widths[1], limit, row)
            _write(row, once[(v - 2 * RADIUS) % RING], noise, fine, low, high, depth_m[v - 2 * RADIUS])


@cell
def _invert(depths, inverse):
    for u in range(depths.size):
        d = depths[u]
        inverse[u + RADIUS] = ONE / d if (d > ZERO) & (d < FAR) else NONE


@cell
def _write(inverse, before, noise, fine, low, high, depths):
    """Write depths where they were to change."""
    for u in range(depths.size):
        c = before[u + RADIUS]
        d = min(max(ONE / inverse[u + RADIUS], low), high)
        depths[u] = d if (_sigma(c, noise) > fine * c * c) & (c > ZERO) else depths[u]


@cell
def _average(ring, last, noise, fine, wide, limit, out):
    """Average the middle row of the ring, whose last row is `last`, with the rows about it; margins stay NONE."""
    rows = (
        ring[(last + 1) % RING], ring[(last + 2) % RING], ring[(last + 3) % RING], ring[(last + 4) % RING],
        ring[(last + 5) % RING], ring[(last + 6) % RING], ring[last % RING],
    )  # fmt: skip
    width = out.size - 2 * RADIUS
    for start in range(0, width, SEGMENT):
        stop = min(start + SEGMENT, width)
        c = _farthest(rows[3][start + RADIUS : stop + RADIUS])
        sigma, step = _sigma(c, noise), fine * c * c
        if sigma > FIVE * step:
            _segment(rows, start, stop, noise, fine, wide, limit, 3, out)
        elif sigma > THREE * step:
            _segment(rows, start, stop, noise, fine, wide, limit, 2, out)
        elif sigma > step:
            _segment(rows, start, stop, noise, fine, wide, limit, 1, out)
        else:
            for u in range(start + RADIUS, stop + RADIUS):
                out[u] = rows[3][u]


@cell
def _farthest(inverse):
    """Return the smallest inverse depth of a segment, the largest of all where it has no value."""
    least = -NONE
    for u in range(inverse.size):
        least = min(least, inverse[u] if inverse[u] > ZERO else -NONE)
    return least


@cell
def _segment(rows, start, stop, noise, fine, wide, limit, radius, out):
    """Average pixels start..stop with up to `radius` neighbours on each side."""
    a3, a2, a1, middle, b1, b2, b3 = rows
    for u in range(start + RADIUS, stop + RADIUS):
        c = middle[u]
        sigma, step = _sigma(c, noise), fine * c * c
        reach = min(wide * sigma, limit * c * c)
        scale = ONE / (reach * reach)
        total, weight = _four(c, middle[u - 1], middle[u + 1], a1[u], b1[u], scale)
        if radius > 1:
            t, w = _four(c, middle[u - 2], middle[u + 2], a2[u], b2[u], scale)
            counts = sigma > THREE * step
            total, weight = total + (t if counts else ZERO), weight + (w if counts else ZERO)
        if radius > 2:
            t, w = _four(c, middle[u - 3], middle[u + 3], a3[u], b3[u], scale)
            counts = sigma > FIVE * step
            total, weight = total + (t if counts else ZERO), weight + (w if counts else ZERO)
        out[u] = c + total / (ONE + weight) if (sigma > step) & (c > ZERO) else c


@cell
def _sigma(c, noise):
    """Return the noise of inverse depth c: sigma(z) / z^2."""
    return min(noise[2] + c * (noise[1] + c * noise[0]), COARSEST)


@cell
def _four(c, p, q, r, s, scale):
    """Return the weighted sum of four neighbours' differences from `c`, and the sum of their weights.

    A weight is (1 - difference^2 scale)^4, not below 0: a neighbour half as far off as may be counts a third.
    """
    p, q, r, s = p - c, q - c, r - c, s - c
    f, g, h, k = _weight(p * p * scale), _weight(q * q * scale), _weight(r * r * scale), _weight(s * s * scale)
    return (f * p + g * q) + (h * r + k * s), (f + g) + (h + k)


@cell
def _weight(square):
    w = max(ONE - square, ZERO)
    w = w * w
    return w * w
