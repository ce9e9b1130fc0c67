# SPDX-License-Identifier: Apache-2.0
"""Kernels on disparity images (height, width) float32 in pixels; NaN: none."""

import numpy as np

from stereovox.kernels._jit import cell, exact_cell, kernel

VALID, UNMATCHED, TOO_NEAR, TOO_FAR, MASKED = np.uint8(0), np.uint8(1), np.uint8(2), np.uint8(3), np.uint8(4)
QUARTER, THREE_QUARTERS = np.float32(0.25), np.float32(0.75)
NAN, ZERO, HALF, ONE = np.float32(np.nan), np.float32(0), np.float32(0.5), np.float32(1)
ONE_PX, FOUR, FIFTEEN, PER_ROW = np.int32(16), np.int32(4), np.int32(15), np.float32(1 / 32)
SLOPE = np.float32(0.1)
NOUGHT, PLUS, MINUS = np.int32(0), np.int32(1), np.int32(-1)
NEXT, SECOND = np.uint64(1), np.uint64(2)
UNITS = np.float32(64)
"""Sums are whole numbers of 1/64 px, so that they come and go without a trace."""


@kernel
def pixels(raw, fractions, lag, out):
    """Fill `out` from `raw` (h, w) int16: counts of 1/16 px, negative: none.

    fractions: (16,) float32, the value in pixels of the last four bits of a count. lag: rows by which disparities
    are late on the way down; corrected along the vertical slope if it is less than one pixel a row.
    """
    height, width = raw.shape
    for v in range(height):
        above, row, below = raw[max(v - 1, 0)], raw[v], raw[min(v + 1, height - 1)]
        for u in range(width):
            a, c, b = np.int32(above[u]), np.int32(row[u]), np.int32(below[u])
            smooth = (a >= 0) & (b >= 0) & (abs(b - c) < ONE_PX) & (abs(c - a) < ONE_PX)
            slope = np.float32(b - a) * PER_ROW if smooth else ZERO
            d = np.float32(c >> FOUR) + fractions[c & FIFTEEN] + lag * slope
            d = d if d > ZERO else ZERO
            out[v, u] = d if c >= 0 else NAN


@kernel
def double(half, first, end, out):
    """Fill rows `first` to `end` of `out` with twice the disparity of halved images (h, w): linear where smooth.

    out: (2 h, 2 w) float32, or one row or column less. A pixel is smooth if linear and nearest interpolation differ by
    less than a pixel; elsewhere the nearest value stays, which keeps edges.
    """
    height, width = half.shape
    for v in range(first, end):
        here = half[v >> 1]
        beside = half[min(max((v >> 1) + (1 if v & 1 else -1), 0), height - 1)]
        row = out[v]
        for u in range(row.size):
            x = u >> 1
            aside = min(max(x + (1 if u & 1 else -1), 0), width - 1)
            nearest = here[x] + here[x]
            linear = _between(_between(here[x], here[aside]), _between(beside[x], beside[aside]))
            linear = linear + linear
            row[u] = linear if abs(linear - nearest) < ONE else nearest


@exact_cell
def _between(near, far):
    return near * THREE_QUARTERS + far * QUARTER


@kernel
def cross_check(disparity, side, most, seen):
    """Drop pixels in place whose partner in the other image has a match nearer by more than `most` pixels.

    side: -1: the partner of u is u - disparity, 1: u + disparity. seen: (w,) float32 scratch.
    """
    height, width = disparity.shape
    for v in range(height):
        row = disparity[v]
        seen[:] = ZERO
        for u in range(width):
            d = row[u]
            if d == d:
                x = _partner(u, d, side, width)
                seen[x] = max(seen[x], d)
        for u in range(width):
            d = row[u]
            if d == d and seen[_partner(u, d, side, width)] - d > most:
                row[u] = NAN


@kernel
def confidence(disparity, radius, tall, first, end, sums, out):
    """Fill `out` with the mean of two windows' confidence that a disparity is right; no value: 0.

    radius: the square window spans this many pixels to each side. tall: the upright one spans this many rows up and
    down,
    and one column to each side. first, end: the rows to fill. sums: (6, w + 2 radius + 1) int32, scratch: sums and
    counts of disparities in the columns of both windows and along the row.
    """
    height = disparity.shape[0]
    sums[:] = NOUGHT
    for v in range(max(first - radius, 0), min(first + radius, height)):
        _put(disparity[v], PLUS, sums[0], sums[1])
    for v in range(max(first - tall, 0), min(first + tall, height)):
        _put(disparity[v], PLUS, sums[2], sums[3])
    for v in range(first, end):
        rows = _enter(disparity, v, radius, first, sums[0], sums[1])
        rows_tall = _enter(disparity, v, tall, first, sums[2], sums[3])
        _running(sums[0], radius, sums[4])
        _running(sums[1], radius, sums[5])
        _trust(disparity[v], rows, rows_tall, radius, sums, out[v])


@cell
def _enter(disparity, v, radius, first, columns, filled):
    """Advance the columns' sums to row v; return how many rows they contain."""
    height = disparity.shape[0]
    if v + radius < height:
        _put(disparity[v + radius], PLUS, columns, filled)
    if v - radius - 1 >= max(first - radius, 0):
        _put(disparity[v - radius - 1], MINUS, columns, filled)
    return min(v + radius, height - 1) - max(v - radius, 0) + 1


@cell
def _trust(row, rows, rows_tall, radius, sums, out):
    width, reach = np.uint64(row.size), np.uint64(2 * radius + 1)
    last, side = np.int32(row.size - 1), np.int32(radius)
    per_row, per_tall = ONE / np.float32(rows), ONE / np.float32(rows_tall)
    columns, filled, line, line_filled = sums[2], sums[3], sums[4], sums[5]
    for u in range(width):
        x, d = np.int32(u), row[u]
        total = np.int32(line[u + reach] - line[u])  # sums may wrap round; differences do not
        count = np.int32(line_filled[u + reach] - line_filled[u])
        square = _say(d, total, count, per_row / _columns(x, side, last))
        upright = _say(d, _of_three(columns, u), _of_three(filled, u), per_tall / _columns(x, PLUS, last))
        out[u] = HALF * (square + upright) if d == d else ZERO


@cell
def _of_three(columns, u):
    return np.int32(np.int32(columns[u] + columns[u + NEXT]) + columns[u + SECOND])


@cell
def _say(d, total, count, per_pixel):
    """Return the cube of the share of a window that has a disparity, reduced if d differs from the window's mean."""
    there = np.float32(count)
    off = abs(d - np.float32(total) / (UNITS * there)) / (ONE + SLOPE * d)
    share = there * per_pixel
    return share * share * share / (ONE + off)


@kernel
def texture(image, down, across, first, end, columns, line, out):
    """Fill `out` (h, w) with the mean of |image[v, u + 1] - image[v, u - 1]| over a window.

    The window spans `down` rows and `across` columns to each side; at the image's sides there is no step, so 0 counts.
    first, end: the rows to fill. columns: (w + 2,) and line: (w + 2 across + 1,) int32, scratch.
    """
    height = image.shape[0]
    columns[:] = NOUGHT
    for v in range(max(first - down, 0), min(first + down, height)):
        _put_steps(image[v], PLUS, columns)
    for v in range(first, end):
        if v + down < height:
            _put_steps(image[v + down], PLUS, columns)
        if v - down - 1 >= max(first - down, 0):
            _put_steps(image[v - down - 1], MINUS, columns)
        rows = min(v + down, height - 1) - max(v - down, 0) + 1
        _running(columns, across, line)
        _mean(line, np.float32(rows), across, out[v])


@cell
def _mean(line, rows, across, out):
    reach, last = np.uint64(2 * across + 1), np.int32(out.size - 1)
    for u in range(np.uint64(out.size)):
        total = np.int32(line[u + reach] - line[u])
        out[u] = np.float32(total) / (rows * _columns(np.int32(u), np.int32(across), last))


@cell
def _columns(u, side, last):
    """Return the width of a window that spans `side` columns to each side of u, limited to the image."""
    return np.float32(np.int32(min(np.int32(u + side), last) - max(np.int32(u - side), NOUGHT)) + PLUS)


@kernel
def explain(disparity, sure, steps, valid, valid_other, side, settings, reason):
    """Drop in place values outside the other image, too near, too far or uncertain; fill `reason`.

    sure: (h, w) confidence, set to 0 for dropped values. steps: (h, w) float32, the texture. valid, valid_other: (h, w)
    bool of the aligned and of the other image, or (0, 0): all may be used. side: as in `cross_check`. settings: (9,)
    float32: most disparity, least, least confidence of any pixel and of a far one, columns cropped at the left and at
    the right, least texture of any pixel, disparity below which more is required, and how much.
    """
    height, width = disparity.shape
    nearest, farthest, least, least_far = settings[0], settings[1], settings[2], settings[3]
    first, end = np.int64(settings[4]), width - np.int64(settings[5])
    textured, doubtful, seen = settings[6], settings[7], settings[8]
    own, other = valid.size > 0, valid_other.size > 0
    for v in range(height):
        for u in range(width):
            d, c = disparity[v, u], sure[v, u]
            x = np.float32(u) + np.float32(side) * d
            outside = (x < -HALF) | (x > np.float32(width) - HALF)
            why = VALID if (d == d) & (not outside) & (c >= least) else UNMATCHED
            why = UNMATCHED if (why == VALID) & (steps[v, u] < (seen if d < doubtful else textured)) else why
            far = d < farthest
            why = (TOO_FAR if c >= least_far else UNMATCHED) if (why == VALID) & far else why
            why = TOO_NEAR if (d >= nearest) & (not outside) else why
            if (u < first) | (u >= end) or (own and not valid[v, u]):
                why = MASKED
            if other and d == d and not valid_other[v, _partner(u, d, side, width)]:
                why = MASKED
            reason[v, u] = why
            disparity[v, u] = d if why == VALID else NAN
            sure[v, u] = c if why == VALID else ZERO


@cell
def _partner(u, d, side, width):
    x = np.int64(np.float32(u) + np.float32(side) * d + HALF)
    return min(max(x, 0), width - 1)


@cell
def _put(row, sign, columns, filled):
    for u in range(np.uint64(row.size)):
        d = row[u]
        there = d == d
        columns[u + NEXT] += sign * (np.int32(d * UNITS) if there else NOUGHT)
        filled[u + NEXT] += sign if there else NOUGHT


@cell
def _put_steps(row, sign, columns):
    for u in range(np.uint64(max(row.size - 2, 0))):
        columns[u + SECOND] += np.int32(sign * abs(np.int32(row[u + SECOND]) - np.int32(row[u])))


@cell
def _running(columns, reach, sums):
    """Fill `sums` (w + 2 reach + 1,) so that sums[u + 2 reach + 1] - sums[u] is the sum of a window of columns round u.

    columns: (w + 2,), with a margin of one to each side. The window spans `reach` of them to each side of u.
    """
    total, width = NOUGHT, sums.size - 2 * reach - 1
    for u in range(reach + 1):
        sums[u] = total
    for u in range(width):
        total = np.int32(total + columns[u + 1])
        sums[u + reach + 1] = total
    for u in range(width + reach + 1, sums.size):
        sums[u] = total
