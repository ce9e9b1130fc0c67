# SPDX-License-Identifier: Apache-2.0
"""Kernel that unpacks RVL, the compression of depth images of RTAB-Map and ROS (Wilson 2017, "Fast Lossless Depth
Image Compression").

Written by hand, because no dependency unpacks RVL, and this one cannot read or write past the given sizes.
"""

from stereovox.kernels._jit import cell, kernel

MOST_GROUPS = 11
"""Most groups of three bits in a number."""
MOST = 0xFFFF
"""Largest depth."""


@kernel
def unpack(words, depth):
    """Fill `depth` (n,) uint16 from `words` (m,) uint32; return the number of pixels written, -1 if damaged.

    Runs alternate: a number of zeros; a number of other values, each as a zigzag step from the last.
    """
    group, written, last = 0, 0, 0
    while written < depth.size:
        zeros, group = _number(words, group)
        if zeros < 0 or written + zeros > depth.size:
            return -1
        depth[written : written + zeros] = 0
        written += zeros
        others, group = _number(words, group)
        if others < 0 or written + others > depth.size or zeros + others == 0:
            return -1
        for k in range(others):
            step, group = _number(words, group)
            if step < 0:
                return -1
            last += (step >> 1) ^ -(step & 1)
            if last < 0 or last > MOST:
                return -1
            depth[written + k] = last
        written += others
    return written


@cell
def _number(words, group):
    """Return the number that begins at a group of four bits, -1 if damaged, and the group behind it.

    Three bits per group, lowest first, after a flag for a following group; eight groups per word, highest first.
    """
    number = 0
    for k in range(MOST_GROUPS):
        if group >= 8 * words.size:
            return -1, group
        bits = (int(words[group >> 3]) >> (28 - 4 * (group & 7))) & 15
        group += 1
        number |= (bits & 7) << (3 * k)
        if bits < 8:
            return number, group
    return -1, group
