# SPDX-License-Identifier: Apache-2.0
"""Kernels on one depth image: metres and reasons, corrections, block minima, shortened range, quality."""

import numpy as np

from stereovox.kernels._jit import cell, kernel

VALID, UNMATCHED, TOO_NEAR, TOO_FAR = np.uint8(0), np.uint8(1), np.uint8(2), np.uint8(3)
MASKED, UNKNOWN = np.uint8(4), np.uint8(5)
NAN, NEAR, FAR = np.float32(np.nan), np.float32(-np.inf), np.float32(np.inf)
ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)
CHUNK = 4096
"""Pixels that stay in the fastest cache between two passes."""


@kernel
def classify(raw, scale, min_range, max_range, none, infinite, given, far, depth_m, reason):
    """Fill `depth_m` (float32, REP 117) and `reason` (uint8) from flat `raw`; return the number of valid pixels.

    none: a raw value that means "no value" in addition to zero, negative ones and NaN (65535 in uint16 images). -inf is
    too near. infinite: what +inf means: itself (too far), or NaN (unknown). given: the source's own reasons, which take
    precedence; empty: it has none. far: what a given TOO_FAR becomes: itself or UNKNOWN. A depth within the range, or
    too near, overrides it.
    """
    valid = np.int64(0)
    for start in range(0, raw.size, CHUNK):
        part = slice(start, start + CHUNK)
        _metres(raw[part], scale, min_range, max_range, none, infinite, depth_m[part])
        if given.size == 0:
            valid += _reasons(depth_m[part], reason[part])
        else:
            valid += _reasons_given(given[part], far, depth_m[part], reason[part])
    return valid


@cell
def _metres(raw, scale, min_range, max_range, none, infinite, depth_m):
    for i in range(raw.size):  # single selects: nested ones become branches, which prevent vectorisation
        value = np.float32(raw[i])
        d = value * scale
        d = NAN if (value == none) | ((d <= ZERO) & (d > NEAR)) else d
        d = infinite if d == FAR else d
        d = NEAR if d < min_range else d
        d = FAR if d > max_range else d
        depth_m[i] = d


@cell
def _reasons(depth_m, reason):
    valid = np.int32(0)
    for i in range(depth_m.size):
        why = _own(depth_m[i])
        reason[i] = np.uint8(why)
        valid = np.int32(valid + (np.int32(1) if why == 0 else np.int32(0)))
    return valid


@cell
def _reasons_given(given, far, depth_m, reason):
    valid = np.int32(0)
    for i in range(given.size):  # numbers as wide as depths: widening the results of byte comparisons is slow
        d, theirs = depth_m[i], np.int32(given[i])
        own = _own(d)
        far_here = np.int32(UNKNOWN) if own == np.int32(VALID) else np.int32(far)
        far_here = np.int32(TOO_NEAR) if own == np.int32(TOO_NEAR) else far_here
        why = _choose(theirs == np.int32(VALID), own, theirs)
        why = _choose(theirs == np.int32(TOO_FAR), far_here, why)
        reason[i] = np.uint8(why)
        instead = NEAR if why == np.int32(TOO_NEAR) else NAN
        instead = FAR if why == np.int32(TOO_FAR) else instead
        depth_m[i] = d if why == np.int32(VALID) else instead
        valid = np.int32(valid + np.int32(why == 0))
    return valid


@cell
def _choose(condition, a, b):
    """Return `a` if the condition holds, else `b`, without a branch."""
    mask = np.int32(-np.int32(condition))
    return np.int32((a & mask) | (b & ~mask))


@cell
def _own(d):
    """Return the reason of a pixel from its REP 117 depth alone."""
    why = np.int32(VALID) if d == d else np.int32(UNKNOWN)
    why = np.int32(TOO_NEAR) if d == NEAR else why
    return np.int32(TOO_FAR) if d == FAR else why


@kernel
def quadratics(s, q, x, y, depth_m):
    """Divide `depth_m` (rows, columns) in place by 1 + s(x, y) + q(x, y) z; NaN if not positive; infinities stay.

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
            row[u] = z if abs(z) == FAR else d


@kernel
def thesis(p, x, depth_m):
    """Subtract p1 X^2 + p2 X + p3 with X = x z from `depth_m` (rows, columns) in place (Chien 2020, Eq A.3)."""
    for v in range(depth_m.shape[0]):
        row = depth_m[v]
        for u in range(x.size):
            z = row[u]
            across = x[u] * z
            d = z - (across * (p[0] * across + p[1]) + p[2])
            d = d if d > ZERO else NAN
            row[u] = z if abs(z) == FAR else d


@kernel
def block_minimum(depth_m, reason, n, row, out_depth, out_reason):
    """Fill `out_depth` and `out_reason` (h / n, w / n, rounded up) from a REP 117 image (h, w) and its reasons.

    row: (w,) float32 scratch for the smallest valid depth of each column of a row of blocks.
    """
    height, width = depth_m.shape
    for i in range(out_depth.shape[0]):
        first, last = i * n, min((i + 1) * n, height)
        row[:] = FAR
        for v in range(first, last):  # whole rows, so that the compiler can process many columns at once
            for u in range(width):
                d = depth_m[v, u]
                row[u] = d if (d > ZERO) & (d < row[u]) else row[u]
        for j in range(out_depth.shape[1]):
            left, right = j * n, min((j + 1) * n, width)
            nearest = FAR
            for u in range(left, right):
                nearest = min(nearest, row[u])
            why = np.uint8(0) if nearest < FAR else _why(reason, first, last, left, right)
            without = NEAR if why == TOO_NEAR else (FAR if why == TOO_FAR else NAN)
            out_depth[i, j] = nearest if why == 0 else without
            out_reason[i, j] = why


@cell
def _why(reason, first, last, left, right):
    """Return the reason of a block without a valid pixel."""
    far, masked, unmatched = True, False, False
    for v in range(first, last):
        for u in range(left, right):
            why = reason[v, u]
            if why == TOO_NEAR:
                return TOO_NEAR
            far = far and why == TOO_FAR
            masked = masked or why == MASKED
            unmatched = unmatched or why == UNMATCHED
    return TOO_FAR if far else (MASKED if masked else (UNMATCHED if unmatched else UNKNOWN))


@kernel
def shorten(depth_m, reason, valid_to, far_from, out_depth, out_reason):
    """Copy flat REP 117 depths and reasons; values beyond `valid_to` are dropped, those from `far_from` on too far."""
    for i in range(depth_m.size):
        d, why = depth_m[i], np.int32(reason[i])
        why = np.int32(UNMATCHED) if d > valid_to else why
        why = np.int32(TOO_FAR) if d > far_from else why
        shown = NAN if d > valid_to else d
        shown = FAR if d > far_from else shown
        out_depth[i] = shown
        out_reason[i] = np.uint8(why)


@kernel
def count(depth_m, step, noise, slack, counts):
    """Count pixels into `counts` (4,) int64: sampled ones; those with a depth or too far; those with a depth whose
    neighbours in the row have one too; and those of the last that are on a surface with both.

    depth_m: (height, width) float32, REP 117; every `step`-th row is sampled. noise: (3,) s0, s1, s2 of the range
    noise, times the largest second difference in sigma. slack: share of the inverse depth that is allowed in addition.
    """
    looked, informative, compared, even = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for v in range(0, depth_m.shape[0], step):
        row = depth_m[v]
        looked += row.size
        for u in range(row.size):
            informative += row[u] > ZERO
        for u in range(1, row.size - 1):
            a, b, c = row[u - 1], row[u], row[u + 1]
            both = (a > ZERO) & (b > ZERO) & (c > ZERO) & (a < FAR) & (b < FAR) & (c < FAR)
            middle = ONE / b
            bend = abs(ONE / a - TWO * middle + ONE / c)
            allowed = (noise[0] * middle + noise[1] + slack) * middle + noise[2]
            compared += both
            even += both & (bend <= allowed)
    counts[0], counts[1], counts[2], counts[3] = looked, informative, compared, even
