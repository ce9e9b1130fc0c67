# SPDX-License-Identifier: Apache-2.0
"""Kernel that unpacks LZF, the compression of PCL's point clouds (format: LibLZF 3.6, lzf_d.c).

Written by hand, because no dependency unpacks LZF, and this one cannot write past the given size.
"""

from stereovox.kernels._jit import kernel

LITERALS = 32
"""Smaller control bytes announce that many literal bytes plus one; others a copy of earlier output."""


@kernel
def unpack(packed, unpacked):
    """Fill `unpacked` (n,) uint8 from `packed` (m,) uint8; return the number of bytes written, -1 if damaged."""
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
            for k in range(length):  # byte by byte, since a copy may overlap its own output
                unpacked[written + k] = unpacked[start + k]
        written += length
    return written
