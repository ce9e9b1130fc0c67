# SPDX-License-Identifier: Apache-2.0
"""Kernels of semi-global matching in 8 bits: all arithmetic is in whole numbers, the same on every processor.

Arrays whose last axis is the disparity d hold the costs of one pixel side by side, so that a vector register takes 32
of them. The right image lies mirrored: what left pixel u shows at disparity d, it has at width - 1 - u + d.
"""

import numpy as np

from stereovox._jit import cell, kernel

PLANES = 6
"""Bytes a pixel is compared by: gradient, its least and largest value within half a pixel, three of the census."""
RIM = 3
"""Rows and columns that an image needs beyond its own: half the census window of 7 by 7 pixels."""
CAP = np.int32(63)
"""Largest gradient along the row, as in OpenCV's matcher."""
MAX_COST = 63 + 24
"""Largest cost of a pixel: half of the gradients' difference, and the bits of the census that differ."""
PAD, ALL, NEXT, WAS = np.uint64(32), np.uint64(64), np.uint64(33), np.uint64(31)
"""Bytes before and behind the path costs of a pixel; those beside them never are the least."""
LANES = np.uint64(64)
"""Disparities of a block: loops of a length that the compiler knows become straight vector code."""
COUNTS = np.int32(16)
NONE = np.int16(-16)
CENSUS = tuple((y, x) for y in range(-RIM, RIM + 1) for x in range(-RIM, RIM + 1) if (x + y) % 2 == 0 and (x or y))
"""Where the 24 bits of the census look: the pixels of one colour of a chess board of 7 by 7."""
FULL, ZERO, ONE, TWO, FOUR = np.uint8(255), np.uint8(0), np.uint8(1), np.uint8(2), np.uint8(4)
PAIRS, QUADS, LOW = np.uint8(0x55), np.uint8(0x33), np.uint8(0x0F)
FAR, NOTHING, NEXT_ONE, NEXT_TWO, WORD = np.uint16(65535), np.uint16(0), np.uint16(1), np.uint16(2), np.uint32(16)


@kernel
def describe(image, first, end, mirrored, line, planes):
    """Fill rows `first` to `end` of `planes` (PLANES, h, w) uint8: what the pixels of an image are compared by.

    image: (h + 2 RIM, w + 2 RIM) uint8, its rim included. mirrored: columns are written from right to left.
    line: (w + 2,) uint8, scratch.
    """
    width = planes.shape[2]
    for v in range(first, end):
        above, here, below = image[v + RIM - 1], image[v + RIM], image[v + RIM + 1]
        for u in range(width + 2):
            slope = np.int32(above[u + 3]) - np.int32(above[u + 1]) + np.int32(below[u + 3]) - np.int32(below[u + 1])
            slope += np.int32(2) * (np.int32(here[u + 3]) - np.int32(here[u + 1]))
            line[u] = np.uint8(min(max(slope, -CAP), CAP) + CAP)
        _ranges(line, planes[0, v], planes[1, v], planes[2, v])
        for part in range(3):
            _census(image, v, part, planes[3 + part, v])
        if mirrored:
            for plane in range(PLANES):
                _turn(planes[plane, v])


@cell
def _ranges(line, middle, least, most):
    for u in range(middle.size):
        here = np.int32(line[u + 1])
        before, after = (here + np.int32(line[u])) >> 1, (here + np.int32(line[u + 2])) >> 1
        middle[u] = np.uint8(here)
        least[u] = np.uint8(min(here, min(before, after)))
        most[u] = np.uint8(max(here, max(before, after)))


@cell
def _census(image, v, part, bits):
    bits[:] = ZERO
    here = image[v + RIM]
    for bit in range(8):
        y, x = CENSUS[8 * part + bit]
        there, weight = image[v + RIM + y], np.uint8(1 << bit)
        for u in range(bits.size):
            bits[u] |= weight if there[u + RIM + x] < here[u + RIM] else ZERO


@cell
def _turn(row):
    for u in range(row.size // 2):
        other = row.size - 1 - u
        row[u], row[other] = row[other], row[u]


@kernel
def match(left, right, rows, settings, ring, sums, window, costs, across, down, total, index, rival, owner, raw):
    """Fill rows of `raw` (h, w) int16 with disparities in 1/16 px, -16: none, by three paths: right, left and down.

    left: (PLANES, h, w); right: (PLANES, h, w + n), mirrored, both of `describe`; n disparities, a multiple of LANES.
    rows: (3,) int32: the first whose costs go down, the first and the end of those written. settings: (7,) int32: half
    the window's side, p1, p2, uniqueness in per cent, most by which the disparities of both images may differ in
    pixels (negative: any), the number by which a sum of costs is multiplied before the lower 16 bits are dropped,
    and the number of disparities that may be chosen.
    Scratch: ring (side + 1, w, n) uint8, sums (w, n) and window (n,) uint16, costs (w, n) uint8, across (2, w, n + 2
    PAD) and down (2, w, n + 2 PAD) uint8, total and index (n,) uint16, rival and owner (w + n,) uint16.
    """
    height, width = raw.shape
    start, first, end = np.int64(rows[0]), np.int64(rows[1]), np.int64(rows[2])
    radius, p1, p2 = np.int64(settings[0]), np.uint8(settings[1]), np.uint8(settings[2])
    slots = 2 * radius + 2
    blocks = np.uint64(window.size) // LANES
    _border(across, p1)
    _border(down, p1)
    sums[:] = np.uint16(0)
    for d in range(window.size):
        index[d] = np.uint16(d)
    for v in range(start - radius, start + radius):
        enter(left, right, min(max(v, 0), height - 1), ring[(v + slots) % slots], sums, blocks)
    for v in range(start, end):
        enter(left, right, min(v + radius, height - 1), ring[(v + radius) % slots], sums, blocks)
        smooth(sums, radius, np.uint32(settings[5]), window, costs, blocks)
        leave(ring[(v - radius + slots) % slots], sums, blocks)
        into, of = down[v & 1], down[1 - (v & 1)]
        downward(costs, of, v == start, p1, p2, into, blocks)
        if v >= first:
            sideways(costs, p1, p2, across, blocks)
            choose(across, into, settings, total, index, rival, owner, raw[v], blocks)


@cell
def _border(paths, p1):
    beyond, last = np.uint8(FULL - p1), paths.shape[2] - 1
    for path in range(paths.shape[0]):
        for u in range(paths.shape[1]):
            for i in range(PAD):
                paths[path, u, i] = beyond
                paths[path, u, last - np.int64(i)] = beyond


@kernel
def enter(left, right, v, costs, sums, blocks):
    """Fill `costs` (w, n) with those of single pixels, and add them to `sums` (w, n) of the rows in the window."""
    width = sums.shape[0]
    for u in range(width):
        at = width - 1 - u
        _compare(left, v, u, right[0, v, at:], right[1, v, at:], right[2, v, at:], right[3, v, at:], right[4, v, at:], right[5, v, at:], costs[u], sums[u], blocks)


@cell
def _compare(left, v, u, middle, least, most, first, second, third, costs, sums, blocks):
    l, l_least, l_most = left[0, v, u], left[1, v, u], left[2, v, u]
    a, b, c = left[3, v, u], left[4, v, u], left[5, v, u]
    for block in range(blocks):
        for i in range(LANES):
            d = block * LANES + i
            r = middle[d]
            one = max(_less(l, most[d]), _less(least[d], l))
            two = max(_less(r, l_most), _less(l_least, r))
            cost = np.uint8(np.uint8(min(one, two) >> ONE) + _ones(np.uint8(a ^ first[d]), np.uint8(b ^ second[d]), np.uint8(c ^ third[d])))
            costs[d] = cost
        for i in range(LANES):
            d = block * LANES + i
            sums[d] = np.uint16(sums[d] + np.uint16(costs[d]))


@cell
def _less(a, b):
    """Return a - b, or 0 where that is negative."""
    return np.uint8(max(a, b) - b)


@cell
def _ones(x, y, z):
    """Return the number of ones in three bytes: adds bits, then pairs, then fours (Warren, Hacker's Delight, 5-1)."""
    odd, pairs = np.uint8(x ^ y), np.uint8(x & y)
    single, double = np.uint8(odd ^ z), np.uint8(pairs | np.uint8(odd & z))
    single = np.uint8(single - np.uint8(np.uint8(single >> ONE) & PAIRS))
    double = np.uint8(double - np.uint8(np.uint8(double >> ONE) & PAIRS))
    single = np.uint8(np.uint8(single & QUADS) + np.uint8(np.uint8(single >> TWO) & QUADS))
    double = np.uint8(np.uint8(double & QUADS) + np.uint8(np.uint8(double >> TWO) & QUADS))
    both = np.uint8(single + np.uint8(double + double))
    return np.uint8(np.uint8(both & LOW) + np.uint8(both >> FOUR))


@kernel
def leave(costs, sums, blocks):
    for u in range(sums.shape[0]):
        for block in range(blocks):
            for i in range(LANES):
                d = block * LANES + i
                sums[u, d] = np.uint16(sums[u, d] - np.uint16(costs[u, d]))


@kernel
def smooth(sums, radius, share, window, costs, blocks):
    """Fill `costs` (w, n) with the means of windows from the sums of their columns; columns beyond repeat the last."""
    width = costs.shape[0]
    window[:] = np.uint16(0)
    for u in range(-radius, radius):
        column = sums[min(max(u, 0), width - 1)]
        for d in range(window.size):
            window[d] = np.uint16(window[d] + column[d])
    for u in range(width):
        _slide(window, sums[min(u + radius, width - 1)], sums[max(u - radius, 0)], share, costs[u], blocks)


@cell
def _slide(window, entering, leaving, share, costs, blocks):
    for block in range(blocks):
        for i in range(LANES):
            d = block * LANES + i
            full = np.uint16(window[d] + entering[d])
            costs[d] = np.uint8((np.uint32(full) * share) >> WORD)
            window[d] = np.uint16(full - leaving[d])


@cell
def _begin(costs, path, blocks):
    """Fill `path` with the costs of its first pixel; return the least."""
    least = FULL
    for block in range(blocks):
        here = FULL
        for i in range(LANES):
            d = block * LANES + i
            path[d + PAD] = costs[d]
            here = min(here, costs[d])
        least = min(least, here)
    return least


@kernel
def downward(costs, of, begins, p1, p2, into, blocks):
    for u in range(costs.shape[0]):
        if begins:
            _begin(costs[u], into[u], blocks)
        else:
            _step(costs[u], of[u], _least(of[u], blocks), p1, p2, into[u], blocks)


@kernel
def sideways(costs, p1, p2, across, blocks):
    """Fill both paths along the row: across[0] goes right, across[1] left."""
    last = costs.shape[0] - 1
    right, left = _begin(costs[0], across[0, 0], blocks), _begin(costs[last], across[1, last], blocks)
    for u in range(1, last + 1):
        v = last - u
        right = _step(costs[u], across[0, u - 1], right, p1, p2, across[0, u], blocks)
        left = _step(costs[v], across[1, v + 1], left, p1, p2, across[1, v], blocks)


@cell
def _step(costs, before, low, p1, p2, after, blocks):
    """Fill `after` with the costs of a path one pixel on (Hirschmueller 2008, Eq 13); return the least."""
    jump, least = np.uint8(low + p2), FULL
    for block in range(blocks):
        here = FULL
        for i in range(LANES):
            d = block * LANES + i
            beside = np.uint8(min(before[d + WAS], before[d + NEXT]) + p1)
            best = min(min(before[d + PAD], beside), jump)
            cost = np.uint8(costs[d] + np.uint8(best - low))
            after[d + PAD] = cost
            here = min(here, cost)
        least = min(least, here)
    return least


@cell
def _least(path, blocks):
    least = FULL
    for block in range(blocks):
        here = FULL
        for i in range(LANES):
            here = min(here, path[block * LANES + i + PAD])
        least = min(least, here)
    return least


@kernel
def choose(across, down, settings, total, index, rival, owner, raw, blocks):
    """Fill a row of disparities from the costs of its paths."""
    width, n = raw.size, np.int64(settings[6])
    unique, most = np.int64(100 - settings[3]), np.int64(settings[4])
    rival[:] = FAR
    for u in range(width):
        at = width - 1 - u
        least = _add(across[0, u], across[1, u], down[u], total, blocks)
        if n < total.size:
            least = _drop(total, n)
        best = _claim(total, index, least, rival[at:], owner[at:], blocks)
        second = _second(total, index, best, blocks)
        certain = np.int64(second) * unique >= np.int64(least) * 100
        raw[u] = _fraction(total, np.int64(best), n) if certain else NONE
    for u in range(width):
        d = np.int64(raw[u])
        if most >= 0 and d >= 0:
            best = (d + 8) >> 4
            raw[u] = NONE if abs(np.int64(owner[width - 1 - u + best]) - best) > most else raw[u]


@cell
def _add(right, left, down, total, blocks):
    """Fill `total` with the sums of three paths; return the least."""
    least = FAR
    for block in range(blocks):
        here = FAR
        for i in range(LANES):
            d = block * LANES + i
            two = np.uint16(np.uint16(right[d + PAD]) + np.uint16(left[d + PAD]))
            cost = np.uint16(two + np.uint16(down[d + PAD]))
            total[d] = cost
            here = min(here, cost)
        least = min(least, here)
    return least


@cell
def _drop(total, n):
    """Make disparities from n on unattractive; return the least cost of the others."""
    least = FAR
    for d in range(n):
        least = min(least, total[d])
    for d in range(n, total.size):
        total[d] = FAR
    return least


@cell
def _claim(total, index, least, rival, owner, blocks):
    """Return the first disparity of least cost; note which one each pixel of the right image likes best."""
    best = FAR
    for block in range(blocks):
        first = FAR
        for i in range(LANES):
            d = block * LANES + i
            others = np.uint16(NOTHING - np.uint16(total[d] != least))
            first = min(first, max(others, index[d]))
        for i in range(LANES):
            d = block * LANES + i
            here, there, it, whose = total[d], rival[d], index[d], owner[d]
            owner[d] = it if here < there else whose
            rival[d] = min(here, there)
        best = min(best, first)
    return best


@cell
def _second(total, index, best, blocks):
    """Return the least cost of all disparities but `best` and those beside it."""
    least, before = FAR, np.uint16(best - NEXT_ONE)
    for block in range(blocks):
        here = FAR
        for i in range(LANES):
            d = block * LANES + i
            near = np.uint16(NOTHING - np.uint16(np.uint16(index[d] - before) <= NEXT_TWO))
            here = min(here, max(near, total[d]))
        least = min(least, here)
    return least


@cell
def _fraction(total, best, n):
    """Return the disparity in 1/16 px at the vertex of the parabola through three costs."""
    if best == 0 or best == n - 1:
        return np.int16(best * 16)
    before, here, after = np.int32(total[best - 1]), np.int32(total[best]), np.int32(total[best + 1])
    bend = np.int32(max(np.int32(before + after - 2 * here), np.int32(1)))
    above = np.uint32(16 * (before - after) + 33 * bend)  # so that it is never negative
    return np.int16(best * 16 - 16 + np.int64(above // np.uint32(2 * bend)))
