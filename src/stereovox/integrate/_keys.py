# SPDX-License-Identifier: Apache-2.0
"""Cells packed into one number: of 32 bits within 2^9 cells of the camera, of 64 bits within 2^19."""

import numpy as np

from stereovox._jit import cell

NARROW, WIDE = 10, 20
"""Bits for each cell coordinate in a key of 32 and of 64 bits."""


@cell
def bits(keys):
    """Return the bits for each cell coordinate in keys of this kind."""
    return NARROW if np.iinfo(keys.dtype).bits == 32 else WIDE


@cell
def pack(x, y, z, keys):
    """Return the key of a cell, of the kind that `keys` holds; negative coordinates down to half the range fit."""
    kind = keys.dtype.type
    b = kind(bits(keys))
    half = kind(1) << (b - kind(1))
    return kind(((kind(x) + half) << (b + b)) | ((kind(y) + half) << b) | (kind(z) + half))


@cell
def unpack(key, b):
    """Return the cell that a key with `b` bits a coordinate (int64) stands for."""
    k, half, mask = np.int64(key), np.int64(1) << (b - 1), (np.int64(1) << b) - 1
    return np.int32((k >> (2 * b)) - half), np.int32(((k >> b) & mask) - half), np.int32((k & mask) - half)


@cell
def strides(signs, keys):
    """Return what one step along x, y and z, forth (sign > 0) or back, adds to a key of the kind that `keys` holds."""
    kind = keys.dtype.type
    b = kind(bits(keys))
    x, y = kind(1) << (b + b), kind(1) << b
    return (
        kind(x if signs[0] > 0 else -x),
        kind(y if signs[1] > 0 else -y),
        kind(1 if signs[2] > 0 else -1),
    )
