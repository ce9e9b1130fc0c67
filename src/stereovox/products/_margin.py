# SPDX-License-Identifier: Apache-2.0
"""Kernel that pads blocks with one cell of their neighbours."""

import numpy as np

from stereovox.kernels._jit import kernel
from stereovox.maps.cells._cells import number_in, row_of

SIDE = 8


@kernel
def with_margin(stored, coords, out):
    """Write the cells of blocks (n, 3), as stored, to `out` (n, 10, 10, 10), surrounded by their neighbours' cells."""
    for n in range(coords.shape[0]):
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    row = row_of(
                        stored, np.int32(coords[n, 0] + dx), np.int32(coords[n, 1] + dy), np.int32(coords[n, 2] + dz)
                    )
                    for x in range(SIDE - 1 if dx < 0 else 0, 1 if dx > 0 else SIDE):
                        for y in range(SIDE - 1 if dy < 0 else 0, 1 if dy > 0 else SIDE):
                            for z in range(SIDE - 1 if dz < 0 else 0, 1 if dz > 0 else SIDE):
                                out[n, 1 + x + SIDE * dx, 1 + y + SIDE * dy, 1 + z + SIDE * dz] = number_in(
                                    stored, row, x, y, z
                                )
