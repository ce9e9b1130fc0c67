# SPDX-License-Identifier: Apache-2.0
"""Rays cast at the outlines of a floor, and how far places are from them. Metres on the floor."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def cast(
    segments: NDArray[np.float64], origin: ArrayLike, angles: ArrayLike, longest: float = np.inf
) -> NDArray[np.float64]:
    """Return how far rays from `origin` (2,) run until they meet a segment, (N,) metres, inf where they meet none.

    segments: (M, 4) x, y from and to. angles: (N,) radians, 0 along x, to the left. longest: what is farther is inf.
    """
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    t = cast_along(within_reach(segments, origin, longest), origin, directions)
    return np.where(t <= longest, t, np.inf)


def cast_along(
    segments: NDArray[np.float64], origin: ArrayLike, directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how often `directions` (N, 2) fit between `origin` (2,) and the first segment, (N,), inf where none is."""
    start = segments[:, :2] - np.asarray(origin, float)
    along = segments[:, 2:] - segments[:, :2]
    x, y = directions[:, :1], directions[:, 1:]
    # start + s along = t (x, y): Cramer's rule
    across = x * along[:, 1] - y * along[:, 0]
    t = np.full(across.shape, np.inf)
    met = across != 0
    np.divide(start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0], across, out=t, where=met)
    s = y * start[:, 0] - x * start[:, 1]
    # 0 <= s / across <= 1 without dividing
    on = met & (s * across >= 0) & (np.abs(s) <= np.abs(across)) & (t >= 0)
    return np.where(on, t, np.inf).min(axis=1, initial=np.inf)


def within_reach(segments: NDArray[np.float64], origin: ArrayLike, reach: float) -> NDArray[np.float64]:
    """Return the segments that touch the square of half width `reach` round `origin`, or nearly so."""
    x, y = np.asarray(origin, float)
    near = (np.minimum(segments[:, 0], segments[:, 2]) <= x + reach) & (
        np.maximum(segments[:, 0], segments[:, 2]) >= x - reach
    )
    near &= np.minimum(segments[:, 1], segments[:, 3]) <= y + reach
    near &= np.maximum(segments[:, 1], segments[:, 3]) >= y - reach
    return segments[near]
