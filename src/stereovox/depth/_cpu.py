# SPDX-License-Identifier: Apache-2.0
"""Kernel that turns raw depth into metres and says why a pixel has no value."""

import numpy as np

from stereovox._jit import cell, kernel

VALID, UNMATCHED, TOO_NEAR, TOO_FAR, MASKED = np.uint8(0), np.uint8(1), np.uint8(2), np.uint8(3), np.uint8(4)
UNKNOWN = np.uint8(5)
NAN, NEAR, FAR = np.float32(np.nan), np.float32(-np.inf), np.float32(np.inf)
ZERO = np.float32(0)


CHUNK = 4096
"""Pixels that stay in the fastest cache from one look at them to the next."""


@kernel
def classify(raw, scale, min_range, max_range, none, infinite, depth_m, reason):
    """Fill `depth_m` (float32, REP 117) and `reason` (uint8) from flat `raw`; return the number of valid pixels.

    none: a raw value that means "no value" beside zero, negative ones and NaN (65535 in uint16 images). -inf is too
    near. infinite: what +inf means: itself (too far), or NaN (nobody knows).
    """
    valid = np.int64(0)
    for start in range(0, raw.size, CHUNK):
        part = slice(start, start + CHUNK)
        _metres(raw[part], scale, min_range, max_range, none, infinite, depth_m[part])
        valid += _reasons(depth_m[part], reason[part])
    return valid


@kernel
def take_given(given, far, depth_m, reason):
    """Let the source's own reasons, where it has any, come first; return the number of valid pixels.

    far: what a given TOO_FAR becomes: itself or UNKNOWN. A depth within the range, or one too near, contradicts it.
    """
    valid = np.int64(0)
    for start in range(0, given.size, CHUNK):
        part = slice(start, start + CHUNK)
        valid += _take(given[part], far, depth_m[part], reason[part])
    return valid


@cell
def _metres(raw, scale, min_range, max_range, none, infinite, depth_m):
    for i in range(raw.size):  # single selects, no nested ones: those become branches and stop vectorisation
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
        d = depth_m[i]
        why = np.int32(VALID) if d == d else np.int32(UNKNOWN)
        why = np.int32(TOO_NEAR) if d == NEAR else why
        why = np.int32(TOO_FAR) if d == FAR else why
        reason[i] = np.uint8(why)
        valid = np.int32(valid + (np.int32(1) if why == 0 else np.int32(0)))
    return valid


@cell
def _take(given, far, depth_m, reason):
    for i in range(given.size):
        said, own = given[i], reason[i]
        why = said if said != VALID else own
        why = far if said == TOO_FAR else why
        why = UNKNOWN if (said == TOO_FAR) & (own == VALID) else why
        reason[i] = TOO_NEAR if (said == TOO_FAR) & (own == TOO_NEAR) else why
    valid = np.int32(0)
    for i in range(given.size):
        why, d = reason[i], depth_m[i]
        d = NAN if (why == UNMATCHED) | (why == MASKED) | (why == UNKNOWN) else d
        d = NEAR if why == TOO_NEAR else d
        d = FAR if why == TOO_FAR else d
        depth_m[i] = d
        valid = np.int32(valid + (np.int32(1) if why == VALID else np.int32(0)))
    return valid
