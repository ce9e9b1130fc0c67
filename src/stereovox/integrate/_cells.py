# SPDX-License-Identifier: Apache-2.0
"""Small kernel functions shared by the integrators, float32 throughout: views, cell keys, table rows."""

import numpy as np

from stereovox.kernels._jit import cell, kernel

ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)
NARROW, WIDE = 10, 20
"""Bits per cell coordinate in a key of 32 and of 64 bits."""
NEAR_PLANE = np.float32(1e-3)
"""Cells with centres at a depth below this (metres) are skipped."""
NO_RETURN = np.float32(1e6)
"""Depth that stands for "nothing up to the maximum range"."""


@kernel
def aim(T_world_camera, cell, side, intrinsics, size, rim, centres, block, rotation, forward, position, sides, steps):
    """Fill block, rotation, forward, position, sides and steps of a `View` for the pose (4, 4).

    cell: (3,) sides of a cell in metres; if they differ, the world is stretched to make cells cubes of `side`.
    intrinsics: fx, fy, cx, cy. size: (2,) width, height. rim: (2,) pixels times depth. centres: (3, 512) of the cells
    of a block, in cells. block: (3,) int32, the camera's block of 8x8x8 cells.
    """
    for a in range(3):
        block[a] = np.int32(np.floor(T_world_camera[a, 3] / (8 * cell[a])))
        stretch = side / cell[a]
        position[a] = stretch * (T_world_camera[a, 3] - 8 * cell[a] * block[a])
        for b in range(3):
            rotation[b, a] = T_world_camera[a, b] / stretch
            forward[b, a] = T_world_camera[a, b] * stretch
    for s in range(4):  # seen: fx x + (cx + 0.5) z + rim >= 0, and likewise for the other three sides
        axis, sign = s >> 1, 1.0 - 2.0 * (s & 1)
        focal, centre = intrinsics[axis], intrinsics[2 + axis]
        room = centre + 0.5 if sign > 0 else size[axis] - 0.5 - centre
        unit_box = 0.0
        for a in range(3):
            stretch = side / cell[a]
            normal = (sign * focal * T_world_camera[a, axis] + room * T_world_camera[a, 2]) / stretch
            sides[s, a] = normal
            unit_box += abs(normal)
        sides[s, 3] = unit_box
        sides[s, 4] = rim[axis] + 1e-3 * max(focal, abs(room))
    for row in range(3):
        focal = intrinsics[row] if row < 2 else 1.0
        x = np.float32(T_world_camera[0, row] * cell[0] * focal)
        y = np.float32(T_world_camera[1, row] * cell[1] * focal)
        z = np.float32(T_world_camera[2, row] * cell[2] * focal)
        for c in range(512):
            steps[row, c] = x * centres[0, c] + y * centres[1, c] + z * centres[2, c]


@cell
def bits(keys):
    """Return the bits per cell coordinate in keys of this type."""
    return NARROW if np.iinfo(keys.dtype).bits == 32 else WIDE


@cell
def pack(x, y, z, keys):
    """Return the key of a cell, of the type of `keys`; negative coordinates down to half the range fit."""
    kind = keys.dtype.type
    b = kind(bits(keys))
    half = kind(1) << (b - kind(1))
    return kind(((kind(x) + half) << (b + b)) | ((kind(y) + half) << b) | (kind(z) + half))


@cell
def unpack(key, b):
    """Return the cell of a key with `b` bits per coordinate (int64)."""
    k, half, mask = np.int64(key), np.int64(1) << (b - 1), (np.int64(1) << b) - 1
    return np.int32((k >> (2 * b)) - half), np.int32(((k >> b) & mask) - half), np.int32((k & mask) - half)


@cell
def strides(signs, keys):
    """Return the changes of a key, of the type of `keys`, by one step forth (sign > 0) or back along x, y and z."""
    kind = keys.dtype.type
    b = kind(bits(keys))
    x, y = kind(1) << (b + b), kind(1) << b
    return (
        kind(x if signs[0] > 0 else -x),
        kind(y if signs[1] > 0 else -y),
        kind(1 if signs[2] > 0 else -1),
    )


@cell
def stronger(old, new):
    """Return the stronger evidence on one cell: positive beats negative, then the larger magnitude wins."""
    if new > 0:
        return max(old, new)
    return old if old > 0 else min(old, new)


@cell
def table_row(depth, rows_per_metre, rows):
    """Return the table row of a measured depth."""
    return min(np.int32(depth * rows_per_metre), np.int32(rows - 1))


@cell
def usable(depth):
    """Return a REP 117 depth as a plain number: no value (NaN, too near) is 0, too far is NO_RETURN."""
    positive = depth if depth > ZERO else ZERO
    return positive if positive < NO_RETURN else NO_RETURN


@cell
def index(i):
    """Return a non-negative int32 as an index without the test for negative indices, and with 32-bit gathers."""
    return np.uint32(i & np.int32(0x7FFFFFFF))


@cell
def bits_of(x):
    """Return the bits of a float32 as int32; for non-negative numbers they order like the numbers."""
    return np.float32(x).view(np.int32)


@cell
def float_of(bits):
    """Return the float32 with these bits."""
    return np.int32(bits).view(np.float32)


@cell
def window_level(spread):
    """Return which window image serves a cell: 0 for the pixel itself, l for 3x3 tiles of 2^(l-1) pixels.

    `spread` is the wanted tile size in pixels; the binary exponent of a float32 is its logarithm rounded down.
    """
    return (bits_of(spread) >> np.int32(23)) - np.int32(125)
