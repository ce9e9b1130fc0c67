# SPDX-License-Identifier: Apache-2.0
"""Kernels of semi-global matching in 8 bits. All arithmetic is in integers: identical on every processor.

Arrays whose last axis is the disparity d hold the costs of one pixel next to each other, so that a vector register
takes many of them. The right image is mirrored: the match of left pixel u at disparity d is at width - 1 - u + d.

The compiler dictates the style: loops over a block of known length become straight vector code, but
only with unsigned indices (others may count from the end) and with every result cut to its bytes at once. A comparison
becomes a mask by arithmetic, as in `_claim`; as a choice it would become a branch, and the loop one pixel at a time.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.kernels._jit import cell, kernel

PLANES = 9
"""Bytes that describe a pixel: its gradient with the least and the most within half a pixel, the same of its
grey value, and the census in three."""
RIM = 3
"""Rows and columns that an image needs beyond its own: half the census window of 7 by 7 pixels."""
GREY = 3
"""The plane of the grey values themselves."""
CAP = np.int32(63)
"""Largest gradient along the row, as in OpenCV's matcher."""
MAX_COST = 63 + 63 + 24
"""Largest cost of a pixel: of its gradient, its grey value, and its census."""
BLOCK = 64
"""Disparities of a block; their number is a multiple of this."""
MARGIN = 32
"""Bytes before and behind the path costs of a pixel."""
CENSUS = tuple((y, x) for y in range(-RIM, RIM + 1) for x in range(-RIM, RIM + 1) if (x + y) % 2 == 0 and (x or y))
"""Offsets of the census's 24 bits: the pixels of one colour of a 7 by 7 chess board."""
NONE = np.int16(-16)
"""No disparity, in the notation of OpenCV's matchers."""
LANES, PAD, BEFORE_PAD, BEHIND_PAD = np.uint64(BLOCK), np.uint64(MARGIN), np.uint64(MARGIN - 1), np.uint64(MARGIN + 1)
LEFT, RIGHT, ONE_ON, TWO_ON = np.uint64(RIM - 2), np.uint64(RIM), np.uint64(1), np.uint64(2)
ZERO, ONE, TWO, FOUR, FULL = np.uint8(0), np.uint8(1), np.uint8(2), np.uint8(4), np.uint8(255)
PAIRS, QUADS, LOW = np.uint8(0x55), np.uint8(0x33), np.uint8(0x0F)
HALF, QUARTERS = np.uint16(8), np.uint16(4)
NOTHING, SINGLE, DOUBLE, FAR, WORD = np.uint16(0), np.uint16(1), np.uint16(2), np.uint16(65535), np.uint32(16)


class Settings(NamedTuple):
    """Settings of `match`, in integers.

    radius: half of the window's side. p1: cost of a step of one disparity. jumps: (256,) cost of larger ones, by the
    step of grey between both pixels. unique: per cent by which the second best match must be worse. left_right: largest
    difference of the disparities of both images, in pixels; negative: any. share: a window's sum of costs times this,
    without its lower 16 bits, is the pixel's cost, at most 255 - p1 - the greatest of `jumps`. disparities: number that
    may be chosen.
    """

    radius: int
    p1: int
    jumps: NDArray[np.uint8]
    unique: int
    left_right: int
    share: int
    disparities: int


class StripScratch(NamedTuple):
    """Memory for a strip of images of width w, n disparities; only the margins keep their values between strips.

    rows: (2 radius + 2, w, n) uint8, costs of single pixels, of the rows in the window. sums: (w, n) uint16 of the
    window's columns. window: (n,) uint16. costs: (w, n) uint8. across, down: (2, w, MARGIN + n + MARGIN) uint8, path
    costs; their margins hold 255 - p1, which is never the least. lows: (w,) uint8. total: (n,) uint16. numbers:
    (n,) uint16, 0 to n - 1. rival, owner: (w + n,) uint16, for pixels of the right image the least cost and its
    disparity.
    """

    rows: NDArray[np.uint8]
    sums: NDArray[np.uint16]
    window: NDArray[np.uint16]
    costs: NDArray[np.uint8]
    across: NDArray[np.uint8]
    down: NDArray[np.uint8]
    lows: NDArray[np.uint8]
    total: NDArray[np.uint16]
    numbers: NDArray[np.uint16]
    rival: NDArray[np.uint16]
    owner: NDArray[np.uint16]


@kernel
def soften(image, first, end, soft):
    """Fill rows `first` to `end` of `soft` (h, w) uint8 with weighted means of 3 by 3 pixels of `image` (h, w) uint8.

    Its census changes less with noise and vertical misalignment of the eyes; gradients are smoothed along columns too.
    image: with its rim, in which the edge is repeated.
    """
    last = image.shape[0] - 1
    for v in range(first, end):
        _soften(image[max(v - 1, 0)], image[v], image[min(v + 1, last)], soft[v])


@cell
def _soften(above, here, below, soft):
    last = np.uint64(soft.size - 1)
    for u in range(np.uint64(1), last):
        before, after = _column(above, here, below, u - ONE_ON), _column(above, here, below, u + ONE_ON)
        soft[u] = _mean(before, _column(above, here, below, u), after)
    soft[0], soft[last] = soft[1], soft[last - ONE_ON]  # in the rim, neighbours are equal


@cell
def _column(above, here, below, u):
    return np.uint16(np.uint16(np.uint16(above[u]) + np.uint16(below[u])) + np.uint16(np.uint16(here[u]) << SINGLE))


@cell
def _mean(before, here, after):
    return np.uint8(np.uint16(np.uint16(before + after) + np.uint16(np.uint16(here << SINGLE) + HALF)) >> QUARTERS)


@kernel
def describe(image, soft, first, end, sign, line, planes):
    """Fill rows `first` to `end` of `planes` (PLANES, h, w) uint8 with the descriptors of an image's pixels.

    image, soft: (h + 2 RIM, w + 2 RIM) uint8, including the rim, and the result of `soften`. sign: 1, or -1 for a
    mirrored image.
    line: (w + 2,) uint8, scratch.
    """
    for v in range(first, end):
        _gradients(image[v + RIM - 1], image[v + RIM], image[v + RIM + 1], np.int32(sign), line)
        _ranges(line, planes[0, v], planes[1, v], planes[2, v])
        _ranges(image[v + RIM, RIM - 1 :], planes[3, v], planes[4, v], planes[5, v])
        for plane in range(6, PLANES):
            planes[plane, v, :] = ZERO
        for bit in range(len(CENSUS)):
            y, x = CENSUS[bit]
            there, weight = soft[v + RIM + y], np.uint8(1 << (bit & 7))
            _darker(there[RIM + sign * x :], soft[v + RIM, RIM:], weight, planes[6 + (bit >> 3), v])


@cell
def _gradients(above, here, below, sign, line):
    for u in range(np.uint64(line.size)):
        left, right = u + LEFT, u + RIGHT
        slope = np.int32(above[right]) - np.int32(above[left]) + np.int32(below[right]) - np.int32(below[left])
        slope = np.int32(slope + np.int32(2) * (np.int32(here[right]) - np.int32(here[left])))
        line[u] = np.uint8(min(max(np.int32(sign * slope), -CAP), CAP) + CAP)


@cell
def _ranges(line, middle, least, most):
    for u in range(np.uint64(middle.size)):
        here, before, after = np.uint16(line[u + ONE_ON]), np.uint16(line[u]), np.uint16(line[u + TWO_ON])
        before, after = np.uint8(np.uint16(here + before) >> SINGLE), np.uint8(np.uint16(here + after) >> SINGLE)
        middle[u] = np.uint8(here)
        least[u] = min(np.uint8(here), min(before, after))
        most[u] = max(np.uint8(here), max(before, after))


@cell
def _darker(there, here, weight, bits):
    for u in range(np.uint64(bits.size)):
        bits[u] = np.uint8(bits[u] | np.uint8(weight & np.uint8(ZERO - np.uint8(there[u] < here[u]))))


@kernel
def match(left, right, start, first, end, settings, scratch, raw):
    """Fill rows `first` to `end` of `raw` (h, w) int16 with disparities in 1/16 px by paths right, left and down.

    left: (PLANES, h, w); right: (PLANES, h, w + n), mirrored; both from `describe`. start: the row from which the
    downward path starts. settings: Settings; scratch: StripScratch. Without a value: NONE.
    """
    height, radius = raw.shape[0], np.int64(settings.radius)
    p1, jumps, share = np.uint8(settings.p1), settings.jumps, np.uint32(settings.share)
    rows, sums, costs, down = scratch.rows, scratch.sums, scratch.costs, scratch.down
    slots, blocks = 2 * radius + 2, np.uint64(costs.shape[1]) // LANES
    sums[:] = NOTHING
    for v in range(start - radius, start + radius):
        enter(left, right, min(max(v, 0), height - 1), rows[(v + slots) % slots], sums, blocks)
    for v in range(start, end):
        enter(left, right, min(v + radius, height - 1), rows[(v + radius) % slots], sums, blocks)
        smooth(sums, radius, share, scratch.window, costs, blocks)
        leave(rows[(v - radius + slots) % slots], sums, blocks)
        into, of = down[v & 1], down[1 - (v & 1)]
        downward(costs, of, v == start, p1, jumps, left[GREY, max(v - 1, 0)], left[GREY, v], scratch.lows, into, blocks)
        if v >= first:
            sideways(costs, p1, jumps, left[GREY, v], scratch.across, blocks)
            choose(
                scratch.across, into, settings, scratch.total, scratch.numbers, scratch.rival, scratch.owner, raw[v],
                blocks,
            )  # fmt: skip


@kernel
def enter(left, right, v, costs, sums, blocks):
    """Fill `costs` (w, n) with those of single pixels, and add them to `sums` (w, n) of the rows in the window."""
    width = sums.shape[0]
    for u in range(width):
        here, there = left[:, v, u], right[:, v, width - 1 - u :]
        _unlike(here, there[0], there[1], there[2], there[3], there[4], there[5], costs[u], blocks)
        _census_unlike(here, there[6], there[7], there[8], costs[u], sums[u], blocks)


@cell
def _unlike(here, slope, slope_least, slope_most, grey, grey_least, grey_most, costs, blocks):
    """Fill `costs` with the differences of gradients and grey values (Birchfield and Tomasi 1998), weighted 2 to 1."""
    s, s_least, s_most, g, g_least, g_most = here[0], here[1], here[2], here[3], here[4], here[5]
    for block in range(blocks):
        for i in range(LANES):
            d = block * LANES + i
            slopes = _apart(s, s_least, s_most, slope[d], slope_least[d], slope_most[d])
            greys = _apart(g, g_least, g_most, grey[d], grey_least[d], grey_most[d])
            costs[d] = np.uint8(np.uint8(slopes >> ONE) + np.uint8(greys >> TWO))


@cell
def _census_unlike(here, first, second, third, costs, sums, blocks):
    """Add the number of differing census bits to `costs`, and these to `sums`."""
    a, b, c = here[6], here[7], here[8]
    for block in range(blocks):
        for i in range(LANES):
            d = block * LANES + i
            bits = _ones(np.uint8(a ^ first[d]), np.uint8(b ^ second[d]), np.uint8(c ^ third[d]))
            costs[d] = np.uint8(costs[d] + bits)
        for i in range(LANES):
            d = block * LANES + i
            sums[d] = np.uint16(sums[d] + np.uint16(costs[d]))


@cell
def _apart(a, a_least, a_most, b, b_least, b_most):
    """Return the distance of each value from the other's range within half a pixel, the smaller of both."""
    return min(max(_less(a, b_most), _less(b_least, a)), max(_less(b, a_most), _less(a_least, b)))


@cell
def _less(a, b):
    """Return a - b, or 0 if that is negative."""
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
    """Subtract the `costs` (w, n) of a row that leaves the window from `sums` (w, n)."""
    for u in range(sums.shape[0]):
        for block in range(blocks):
            for i in range(LANES):
                d = block * LANES + i
                sums[u, d] = np.uint16(sums[u, d] - np.uint16(costs[u, d]))


@kernel
def smooth(sums, radius, share, window, costs, blocks):
    """Fill `costs` (w, n) with window means from the sums of columns; beyond the last column, repeat it."""
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
            costs[d] = np.uint8(np.uint32(np.uint32(full) * share) >> WORD)
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
def downward(costs, of, begins, p1, jumps, above, grey, lows, into, blocks):
    """Fill the downward path `into` (w, MARGIN + n + MARGIN) from that of the row above, unless it `begins` here.

    above, grey: (w,) uint8, the image in that row and in this. jumps: of `Settings`. lows: (w,) the least of each
    pixel's path costs, updated.
    """
    for u in range(costs.shape[0]):
        if begins:
            lows[u] = _begin(costs[u], into[u], blocks)
        else:
            jump = _jump(jumps, above[u], grey[u])
            lows[u] = _step(costs[u], of[u], lows[u], p1, jump, into[u], blocks)


@kernel
def sideways(costs, p1, jumps, grey, across, blocks):
    """Fill both paths along the row: across[0] goes right, across[1] left."""
    last = costs.shape[0] - 1
    right, left = _begin(costs[0], across[0, 0], blocks), _begin(costs[last], across[1, last], blocks)
    for u in range(1, last + 1):
        v = last - u
        to_right, to_left = _jump(jumps, grey[u - 1], grey[u]), _jump(jumps, grey[v + 1], grey[v])
        right = _step(costs[u], across[0, u - 1], right, p1, to_right, across[0, u], blocks)
        left = _step(costs[v], across[1, v + 1], left, p1, to_left, across[1, v], blocks)


@cell
def _jump(jumps, before, here):
    """Return the cost of a jump between two pixels of these grey values."""
    return jumps[max(before, here) - min(before, here)]


@cell
def _step(costs, before, low, p1, p2, after, blocks):
    """Fill `after` with the costs of a path one pixel further (Hirschmueller 2008, Eq 13); return the least."""
    jump, least = np.uint8(low + p2), FULL
    for block in range(blocks):
        here = FULL
        for i in range(LANES):
            d = block * LANES + i
            beside = np.uint8(min(before[d + BEFORE_PAD], before[d + BEHIND_PAD]) + p1)
            best = min(min(before[d + PAD], beside), jump)
            cost = np.uint8(costs[d] + np.uint8(best - low))
            after[d + PAD] = cost
            here = min(here, cost)
        least = min(least, here)
    return least


@kernel
def choose(across, down, settings, total, numbers, rival, owner, raw, blocks):
    """Fill a row of disparities from the costs of its paths (`StripScratch`)."""
    width, n = raw.size, np.int64(settings.disparities)
    unique, most = np.int64(100 - settings.unique), np.int64(settings.left_right)
    rival[:] = FAR
    for u in range(width):
        at = width - 1 - u
        least = _add(across[0, u], across[1, u], down[u], total, blocks)
        if n < total.size:
            least = _drop(total, n)
        best = _claim(total, numbers, least, rival[at:], owner[at:], blocks)
        second = _second(total, numbers, best, blocks)
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
    """Exclude disparities from n on by high costs; return the least cost of the others."""
    least = FAR
    for d in range(n):
        least = min(least, total[d])
    for d in range(n, total.size):
        total[d] = FAR
    return least


@cell
def _claim(total, numbers, least, rival, owner, blocks):
    """Return the first disparity of least cost; note the best one of each pixel of the right image."""
    best = FAR
    for block in range(blocks):
        first = FAR
        for i in range(LANES):
            d = block * LANES + i
            others = np.uint16(NOTHING - np.uint16(total[d] != least))
            first = min(first, max(others, numbers[d]))
        for i in range(LANES):
            d = block * LANES + i
            here, there, it, whose = total[d], rival[d], numbers[d], owner[d]
            owner[d] = it if here < there else whose
            rival[d] = min(here, there)
        best = min(best, first)
    return best


@cell
def _second(total, numbers, best, blocks):
    """Return the least cost of all disparities except `best` and its neighbours."""
    least, before = FAR, np.uint16(best - SINGLE)
    for block in range(blocks):
        here = FAR
        for i in range(LANES):
            d = block * LANES + i
            near = np.uint16(NOTHING - np.uint16(np.uint16(numbers[d] - before) <= DOUBLE))
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
