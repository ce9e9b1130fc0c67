# SPDX-License-Identifier: Apache-2.0
"""The kernel that denoises a depth image: means over similar neighbours, and over lines in front of a wall."""

import numpy as np

from stereovox.kernels._jit import cell, kernel

FAR = np.float32(np.inf)
ZERO, ONE = np.float32(0), np.float32(1)
SEGMENT = 32
"""Pixels of a row that are skipped together if none of them is noisy."""
NONE = np.float32(-1e6)
"""Inverse depth of a pixel without value: far from every real one."""
COARSEST = np.float32(1e4)
"""Bound for the noise of inverse depth, so that NONE stays far from all values."""
TAPS, SIDE = 2, 3
"""Pixels of a line on each side of its middle, and distance to its background; in steps of the first pass."""
STANDS, WITHIN = np.float32(1.5), np.float32(2)
"""Sigma by which each half of a line is in front of both sides, and by which its middle may be behind its mean."""
THREE, FIFTH = np.float32(3), np.float32(0.2)


@kernel
def denoise(depth_m, noise, steps, fine, widths, limit, low, high, rings, noisy, lines):
    """Replace every depth by a weighted mean over neighbours, in place; pixels without value stay as they are.

    depth_m: (h, w) REP 117 depth image. noise: (3,) s0, s1, s2 of the depth noise in metres. For each pass:
    steps: (passes,) int64, ascending, distance of its four neighbours in pixels; fine: noise in metres up to which it
    leaves a pixel unchanged; widths: difference in sigma at which a neighbour no longer counts. limit: cap of sigma,
    metres. Finally lines get their own means (`_lines`) if noise exceeds the last `fine`. low, high: results are
    kept within these depths. rings: scratch (passes + 1, passes m + (SIDE + TAPS) steps[0] + 1, w + 2 m), m the
    largest step and w rounded up to SEGMENT: inverse depths of the current rows, measured and after each pass.
    noisy: scratch (rows of rings, w / SEGMENT) uint8, whether any pixel of a segment takes part in a pass. lines:
    whether lines get their own means.
    """
    height, passes, rows, margin, apart = depth_m.shape[0], steps.size, rings.shape[1], steps[-1], steps[0]
    rings[:, :, :] = NONE
    lag = passes * margin + SIDE * apart
    for v in range(height + lag):
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
                    noisy[middle % rows],
                )  # fmt: skip
            elif middle >= height:
                rings[i + 1, middle % rows, :] = NONE
        last = v - lag
        if last >= 0:
            _write(rings[passes, last % rows], np.uintp(margin), noise, fine[0], low, high, depth_m[last])
            if lines:
                _lines(
                    rings, noisy[last % rows], last, apart, np.uintp(margin), noise, fine[passes - 1], low, high,
                    depth_m[last],
                )  # fmt: skip


@cell
def _lines(rings, noisy, v, apart, margin, noise, fine, low, high, depths):
    """Write depths of row v if a line of measured depths is in front of the averaged ones at both its sides.

    A rod one or two pixels wide has more neighbours on the wall than on itself, and was averaged into the wall.
    """
    raw, averaged, rows = rings[0], rings[-1], rings.shape[1]
    near, far, side = np.uintp(apart), np.uintp(2 * apart), np.uintp(SIDE * apart)
    measured = (
        raw[(v - 2 * apart) % rows], raw[(v - apart) % rows], raw[v % rows], raw[(v + apart) % rows],
        raw[(v + 2 * apart) % rows],
    )  # fmt: skip
    around = (
        averaged[(v - SIDE * apart) % rows], averaged[(v - 2 * apart) % rows], averaged[v % rows],
        averaged[(v + 2 * apart) % rows], averaged[(v + SIDE * apart) % rows],
    )  # fmt: skip
    row, middle = measured[2], around[2]
    for start in range(margin, np.uintp(row.size) - margin, np.uintp(SEGMENT)):
        if not (noisy[_segment(start, margin)] and _any_line(measured, around, start, near, far, side, noise)):
            continue
        for u in range(start, min(start + np.uintp(SEGMENT), margin + np.uintp(depths.size))):
            c, best, sigma = row[u], middle[u], _sigma(middle[u], noise)
            for first, second, behind in _halves(measured, around, u, near, far, side):
                mean = (c + first + second) * FIFTH
                stands = (c + min(first, second) > THREE * (behind + STANDS * sigma)) & (behind > ZERO)
                best = max(best, mean if stands & (c > mean - WITHIN * sigma) else NONE)
            if (best > middle[u]) & (sigma > fine * middle[u] * middle[u]):
                depths[u - margin] = min(max(ONE / best, low), high)


@cell
def _any_line(measured, around, start, near, far, side, noise):
    """Return whether any pixel of a segment may be on a line in front of both its sides."""
    number = np.int32(0)
    for i in range(np.uintp(SEGMENT)):
        u = start + i
        a, b, c, d = _halves(measured, around, u, near, far, side)
        most = max(max(_before(a), _before(b)), max(_before(c), _before(d)))
        number += np.int32(measured[2][u] + most > THREE * STANDS * _sigma(around[2][u], noise))
    return number > 0


@cell
def _before(line):
    first, second, behind = line
    return min(first, second) - THREE * behind


@cell
def _halves(measured, around, u, near, far, side):
    """Return the sums of the halves of vertical, horizontal and both diagonal lines, and the depths at their sides."""
    a, b, c, d, e = measured
    f, g, h, i, j = around
    return (
        (b[u] + a[u], d[u] + e[u], max(h[u - side], h[u + side])),
        (c[u - near] + c[u - far], c[u + near] + c[u + far], max(f[u], j[u])),
        (b[u - near] + a[u - far], d[u + near] + e[u + far], max(g[u + far], i[u - far])),
        (b[u + near] + a[u + far], d[u - near] + e[u - far], max(g[u - far], i[u + far])),
    )


@cell
def _invert(depths, inverse, margin):
    for u in range(np.uintp(depths.size)):  # unsigned, here and below: otherwise each index is compared with 0
        d = depths[u]
        inverse[u + np.uintp(margin)] = ONE / d if (d > ZERO) & (d < FAR) else NONE


@cell
def _write(inverse, margin, noise, fine, low, high, depths):
    """Write the depths that this filter may change."""
    for u in range(np.uintp(depths.size)):
        d = depths[u]
        counts = (noise[0] + d * (noise[1] + d * noise[2]) > fine) & (d > ZERO) & (d < FAR)
        depths[u] = min(max(ONE / inverse[u + margin], low), high) if counts else d


@cell
def _average(above, row, below, step, margin, noise, fine, wide, limit, out, noisy):
    """Average the pixels of a row with those `step` away in the row and in the rows above and below; skip margins."""
    for start in range(margin, np.uintp(row.size) - margin, np.uintp(SEGMENT)):
        takes_part = _any_noisy(row, start, noise, fine)
        noisy[_segment(start, margin)] = takes_part
        if takes_part:
            for i in range(np.uintp(SEGMENT)):
                u = start + i
                c = row[u]
                sigma, square = _sigma(c, noise), c * c
                reach = wide * min(sigma, limit * square)
                total, weight = _four(c, row[u - step], row[u + step], above[u], below[u], ONE / (reach * reach))
                out[u] = c + total / (ONE + weight) if (sigma > fine * square) & (c > ZERO) else c
        else:
            for i in range(np.uintp(SEGMENT)):
                out[start + i] = row[start + i]


@cell
def _segment(start, margin):
    return (start - margin) // np.uintp(SEGMENT)


@cell
def _any_noisy(inverse, start, noise, fine):
    """Return whether any pixel of a segment has more noise than `fine`."""
    number = np.int32(0)
    for i in range(np.uintp(SEGMENT)):
        c = inverse[start + i]
        number += np.int32((_sigma(c, noise) > fine * c * c) & (c > ZERO))
    return number > 0


@cell
def _sigma(c, noise):
    """Return the noise of inverse depth c: sigma(z) / z^2."""
    return min(noise[2] + c * (noise[1] + c * noise[0]), COARSEST)


@cell
def _four(c, p, q, r, s, scale):
    """Return the weighted sum of four neighbours' differences from `c`, and the sum of their weights.

    A weight is (1 - difference^2 scale)^4, at least 0: a neighbour at half the largest difference counts one third.
    """
    p, q, r, s = p - c, q - c, r - c, s - c
    f, g, h, k = _weight(p * p * scale), _weight(q * q * scale), _weight(r * r * scale), _weight(s * s * scale)
    return (f * p + g * q) + (h * r + k * s), (f + g) + (h + k)


@cell
def _weight(square):
    w = max(ONE - square, ZERO)
    w = w * w
    return w * w
