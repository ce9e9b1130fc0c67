# SPDX-License-Identifier: Apache-2.0
"""Kernel that turns raw depth into metres and says why a pixel has no value."""

import numpy as np

from stereovox._jit import kernel

VALID, UNMATCHED, TOO_NEAR, TOO_FAR, MASKED = np.uint8(0), np.uint8(1), np.uint8(2), np.uint8(3), np.uint8(4)
NAN, NEAR, FAR = np.float32(np.nan), np.float32(-np.inf), np.float32(np.inf)
ZERO = np.float32(0)
SATURATED = np.float32(65535)


@kernel
def classify(raw, given, scale, min_range, max_range, saturates, depth_m, reason):
    """Fill `depth_m` (float32) and `reason` (uint8) from flat `raw`; return the number of valid pixels.

    `given` holds the source's own reasons, or is empty. `saturates`: the value 65535 means "none" (uint16 images).
    """
    known = given.size == raw.size
    valid = 0
    for i in range(raw.size):
        value = np.float32(raw[i])
        d = value * scale
        finite = (d > ZERO) & (d < FAR) & ~(saturates & (value == SATURATED))
        why = VALID if finite else UNMATCHED
        why = TOO_NEAR if finite & (d < min_range) else why
        why = TOO_FAR if finite & (d > max_range) else why
        if known:
            why = given[i] if given[i] != VALID else why
        reason[i] = why
        d = NAN if (why == UNMATCHED) | (why == MASKED) else d
        d = NEAR if why == TOO_NEAR else d
        d = FAR if why == TOO_FAR else d
        depth_m[i] = d
        valid += 1 if why == VALID else 0
    return valid
