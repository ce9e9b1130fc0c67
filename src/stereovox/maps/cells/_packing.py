# SPDX-License-Identifier: Apache-2.0
"""Kernels that turn an image into easily compressed bytes, and back without loss."""

from stereovox.kernels._jit import kernel


@kernel
def split(bits, planes):
    """Write the differences between neighbouring numbers as planes of bytes, the lowest bytes first.

    Each number (h, w) uint16 or uint32 minus the one to its left, in the first column the one above; small negative
    differences become small numbers (zigzag). planes: (2 or 4, h, w) uint8.
    """
    last = 8 * planes.shape[0] - 1
    mask = (2 << last) - 1
    for v in range(bits.shape[0]):
        for n in range(planes.shape[0]):
            above = int(bits[v - 1, 0]) if v else 0
            step = (int(bits[v, 0]) - above) & mask
            planes[n, v, 0] = (((step << 1) ^ -(step >> last)) >> (8 * n)) & 255
            for u in range(1, bits.shape[1]):
                step = (int(bits[v, u]) - int(bits[v, u - 1])) & mask
                planes[n, v, u] = (((step << 1) ^ -(step >> last)) >> (8 * n)) & 255


@kernel
def join(planes, bits):
    """Undo `split`: write the numbers (h, w) that it split into these planes."""
    mask = (2 << (8 * planes.shape[0] - 1)) - 1
    for v in range(bits.shape[0]):
        for u in range(bits.shape[1]):
            bits[v, u] = planes[0, v, u]
        for n in range(1, planes.shape[0]):
            for u in range(bits.shape[1]):
                bits[v, u] |= int(planes[n, v, u]) << (8 * n)
        before = int(bits[v - 1, 0]) if v else 0
        for u in range(bits.shape[1]):
            folded = int(bits[v, u])
            before = (before + ((folded >> 1) ^ -(folded & 1))) & mask
            bits[v, u] = before
