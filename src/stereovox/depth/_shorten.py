# SPDX-License-Identifier: Apache-2.0
"""Kernel that takes the far part out of a depth image."""

import numpy as np

from stereovox._jit import kernel

UNMATCHED, TOO_FAR = np.uint8(1), np.uint8(3)
NAN, FAR = np.float32(np.nan), np.float32(np.inf)


@kernel
def shorten(depth_m, reason, valid_to, far_from, out_depth, out_reason):
    """Copy flat REP 117 depths and reasons; beyond `valid_to` there is no value, from `far_from` on it is too far."""
    for i in range(depth_m.size):
        d, why = depth_m[i], np.int32(reason[i])
        why = np.int32(UNMATCHED) if d > valid_to else why
        why = np.int32(TOO_FAR) if d > far_from else why
        shown = NAN if d > valid_to else d
        shown = FAR if d > far_from else shown
        out_depth[i] = shown
        out_reason[i] = np.uint8(why)
