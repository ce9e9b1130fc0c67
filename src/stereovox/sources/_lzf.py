# SPDX-License-Identifier: Apache-2.0
"""Kernel that unpacks LZF, in which PCL packs its point clouds (format: LibLZF 3.6, lzf_d.c).

By hand, because no dependency unpacks LZF, and this one cannot write past the size it was given.
"""

from stereovox.kernels._jit import kernel

LITERALS = 32
"""Control bytes below it announce so many bytes and one more; others a piece of what was written before."""


@kernel
def unpack(packed, unpacked):
    """Fill `unpacked` (n,) uint8 from `packed` (m,) uint8; return how many bytes were written, -1 for damage."""
    read, written = 0, 0
    while read < packed.size:
        control = packed[read]
        read += 1
        if control < LITERALS:
            length = control + 1
            if read + length > packed.size or written + length > unpacked.size:
                return -1
            for k in range(length):
                unpacked[written + k] = packed[read + k]
            read += length
        else:
            length = control >> 5
            if length == 7:
                if read >= packed.size:
                    return -1
                length += packed[read]
                read += 1
            if read >= packed.size:
                return -1
            start = written - ((control & 31) << 8) - packed[read] - 1
            read += 1
            length += 2
            if start < 0 or written + length > unpacked.size:
                return -1
            for k in range(length):  # byte by byte: a piece may reach into itself
                unpacked[written + k] = unpacked[start + k]
        written += length
    return written
