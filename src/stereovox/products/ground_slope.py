# SPDX-License-Identifier: Apache-2.0
"""How steep a height map is, and how high its steps are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST = 2
"""Cells on each side over which a slope is taken at least: heights come in whole cells."""


def slopes(height: NDArray[np.float64], side: float, radius: float) -> NDArray[np.float64]:
    """Return the slope (rows, columns), rise over run, of the plane that fits the heights about each cell best.

    height: (rows, columns) metres, NaN where there is none. The square about a cell reaches `radius` metres to each
    side, two cells at least. 0 where there is no height, or where the heights about it lie on one line of cells.
    """
    from scipy.ndimage import correlate1d

    reach = max(int(np.ceil(min(radius / side, max(height.shape)) - 1e-9)), LEAST)  # farther off there is nothing
    known = ~np.isnan(height)
    z = np.where(known, height - (height[known].mean() if known.any() else 0), 0.0)
    run = np.arange(-reach, reach + 1) * side

    def moment(values: NDArray[np.float64], across: int, away: int) -> NDArray[np.float64]:
        """Return the sum of values * x^across * y^away over the square."""
        rows = correlate1d(values, run**across, axis=1, mode="constant")
        return correlate1d(rows, run**away, axis=0, mode="constant")

    one = known.astype(float)
    n = np.maximum(moment(one, 0, 0), 1)
    x, y, mean = moment(one, 1, 0) / n, moment(one, 0, 1) / n, moment(z, 0, 0) / n
    xx, xy, yy = moment(one, 2, 0) / n - x * x, moment(one, 1, 1) / n - x * y, moment(one, 0, 2) / n - y * y
    xz, yz = moment(z, 1, 0) / n - x * mean, moment(z, 0, 1) / n - y * mean
    determinant = xx * yy - xy * xy
    flat = ~known | (determinant < 1e-6 * side**4)
    determinant = np.where(flat, 1.0, determinant)
    slope = np.hypot(yy * xz - xy * yz, xx * yz - xy * xz) / determinant
    return np.where(flat, 0.0, slope)


def beside(height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much higher or lower (rows, columns) the ground beside each cell is, at most; 0 for none."""
    from scipy.ndimage import maximum_filter, minimum_filter

    known = ~np.isnan(height)
    highest = maximum_filter(np.where(known, height, -np.inf), 3, mode="nearest")
    lowest = minimum_filter(np.where(known, height, np.inf), 3, mode="nearest")
    here = np.where(known, height, 0.0)
    return np.where(known, np.maximum(highest - here, here - lowest), 0.0)
