# SPDX-License-Identifier: Apache-2.0
"""Kernel that projects the columns of a map's blocks."""

from __future__ import annotations

import numpy as np

from stereovox.kernels._jit import kernel

SIDE, NOTHING, ONE = 8, np.int16(-(2**15)), np.int16(1)


@kernel
def look_down(coords, values, order, corner, first, last, unknown, free_below, marked, free):
    """Project columns onto the cells of a floor: blocks (n, 3), their cells (n, 512) as stored.

    order: which axes of the map go along columns, along rows and up; corner: lowest cell along the first two.
    first, last: (rows, columns) int32, layers along the third that count. Raises `marked` to the largest stored number
    of these, and adds the number below `free_below` to `free`; both (rows, columns) int16.
    """
    across, away, upwards = SIDE ** (2 - order[0]), SIDE ** (2 - order[1]), SIDE ** (2 - order[2])
    for n in range(coords.shape[0]):
        column = coords[n, order[0]] * SIDE - corner[0]
        row = coords[n, order[1]] * SIDE - corner[1]
        bottom = coords[n, order[2]] * SIDE
        for i in range(SIDE):
            for j in range(SIDE):
                lowest, top = first[row + j, column + i] - bottom, last[row + j, column + i] - bottom
                highest, number_free = marked[row + j, column + i], free[row + j, column + i]
                for k in range(SIDE):  # selects, because branches here are unpredictable
                    number = np.int16(values[n, i * across + j * away + k * upwards])
                    inside = (number != unknown) & (k >= lowest) & (k <= top)
                    highest = max(highest, number if inside else NOTHING)
                    number_free = np.int16(number_free + (ONE if inside & (number < free_below) else np.int16(0)))
                marked[row + j, column + i], free[row + j, column + i] = highest, number_free
