# SPDX-License-Identifier: Apache-2.0
"""Kernel that unpacks RVL (Wilson 2017, "Fast Lossless Depth Image Compression"), as compressed_depth_image_transport
writes it: words of 32 bits, each of eight nibbles, the highest first; three bits of a number in each, the lowest first.
"""

from stereovox.kernels._jit import cell, kernel


@cell
def _number(words, at):
    """Return the number that begins at nibble `at`, and where the next one begins; -1 at the end of the words."""
    value, shift = 0, 0
    while at < 8 * words.size and shift < 30:
        nibble = (words[at >> 3] >> (28 - 4 * (at & 7))) & 15
        at += 1
        value |= (nibble & 7) << shift
        shift += 3
        if nibble < 8:
            return value, at
    return -1, at


@kernel
def unpack(words, pixels):
    """Fill `pixels` (n,) uint16 from `words` (m,) int64 of 32 bits; return whether they hold exactly that many."""
    at, done, depth = 0, 0, 0
    while done < pixels.size:
        zeros, at = _number(words, at)
        if zeros < 0 or done + zeros > pixels.size:
            return False
        pixels[done : done + zeros] = 0
        done += zeros
        if done == pixels.size and at == 8 * words.size:
            return True
        values, at = _number(words, at)
        if values < 0 or done + values > pixels.size or (zeros == 0 and values == 0):
            return False
        for _ in range(values):
            step, at = _number(words, at)
            if step < 0:
                return False
            depth += (step >> 1) ^ -(step & 1)
            if depth < 0 or depth > 65535:
                return False
            pixels[done] = depth
            done += 1
    return True
