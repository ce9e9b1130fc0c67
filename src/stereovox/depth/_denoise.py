# SPDX-License-Identifier: Apache-2.0
"""Kernel that averages each pixel with like pixels in its row and its column, near ones first, then farther ones."""

import numpy as np

from stereovox._jit import cell, kernel

SEGMENT = 64
"""Pixels of a row that are left out together where none of them is noisy."""
NONE = np.float32(-1e6)
"""Inverse depth of a pixel without value: far from every other."""
COARSEST = np.float32(1e4)
"""Bound for the noise of inverse depth, so that NONE stays far from everything."""
ZERO, ONE, FAR = np.float32(0), np.float32(1), np.float32(np.inf)


@kernel
def denoise(depth_m, noise, steps, fine, widths, limit, low, high, rings):
    """Replace every depth by a weighted mean over neighbours, in place; pixels without value stay as they are.

    depth_m: (h, w) REP 117 depth image. noise: (3,) s0, s1, s2 of the depth noise in metres. One pass after another:
    steps: (passes,) int64, how many pixels away its four neighbours are; fine: the noise in metres, up to which it
    leaves a pixel; widths: how many sigma off a neighbour no longer counts; `limit`: metres, sigma counts for no more.
    low, high: results are kept within these depths. rings: scratch (passes + 1, 2 m + 1, w + 2 m), m the largest
    step: inverse depths of the rows that are needed, measured and after each pass.
    """
    height, passes, rows = depth_m.shape[0], steps.size, rings.shape[1]
    margin = rows // 2
    rings[:, :, :] = NONE
    for v in range(height + passes * margin):
        if v < height:
            _invert(depth_m[v], rings[0, v % rows], margin)
        else:
            rings[0, v % rows, :] = NONE
        for i in range(passes):
            middle = v - (i + 1) * margin
            if 0 <= middle < height:
                ring, step = rings[i], steps[i]
                _average(
                    ring[(middle - step) % rows], ring[middle % rows], ring[(middle + step) % rows], np.uintp(step),
                    np.uintp(margin), noise, fine[i], widths[i], limit, rings[i + 1, middle % rows],
                )  # fmt: skip
            elif middle >= height:
                rings[i + 1, middle % rows, :] = NONE
        last = v - passes * margin
        if last >= 0:
            _write(rings[passes, last % rows], np.uintp(margin), noise, fine[0], low, high, depth_m[last])


@cell
def _invert(depths, inverse, margin):
    for u in range(np.uintp(depths.size)):  # unsigned, here and below: else each index is first compared with 0
        d = depths[u]
        inverse[u + np.uintp(margin)] = ONE / d if (d > ZERO) & (d < FAR) else NONE


@cell
def _write(inverse, margin, noise, fine, low, high, depths):
    """Write depths where they were to change."""
    for u in range(np.uintp(depths.size)):
        d = depths[u]
        counts = (noise[0] + d * (noise[1] + d * noise[2]) > fine) & (d > ZERO) & (d < FAR)
        depths[u] = min(max(ONE / inverse[u + margin], low), high) if counts else d


@cell
def _average(above, row, below, step, margin, noise, fine, wide, limit, out):
    """Average the pixels of a row with those `step` beside them, and in the rows above and below; margins stay."""
    end = np.uintp(row.size) - margin
    for start in range(margin, end, np.uintp(SEGMENT)):
        stop = min(start + np.uintp(SEGMENT), end)
        if _any_noisy(row, start, stop, noise, fine):
            for u in range(start, stop):
                c = row[u]
                sigma, square = _sigma(c, noise), c * c
                reach = wide * min(sigma, limit * square)
                total, weight = _four(c, row[u - step], row[u + step], above[u], below[u], ONE / (reach * reach))
                out[u] = c + total / (ONE + weight) if (sigma > fine * square) & (c > ZERO) else c
        else:
            for u in range(start, stop):
                out[u] = row[u]


@cell
def _any_noisy(inverse, start, stop, noise, fine):
    """Tell whether a pixel has more noise than `fine`."""
    number = np.int32(0)
    for u in range(start, stop):
        c = inverse[u]
        number += np.int32((_sigma(c, noise) > fine * c * c) & (c > ZERO))
    return number > 0


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
