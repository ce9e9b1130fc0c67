# SPDX-License-Identifier: Apache-2.0
"""Cells turned so that their third axis points up, and the ceiling above them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

UPS = {"z": (0, 1, 2), "-z": (1, 0, 2), "y": (2, 0, 1), "-y": (0, 2, 1), "x": (1, 2, 0), "-x": (2, 1, 0)}
"""For each up axis: the map's axes that point right, away and up in a picture (the last flipped if minus)."""
SLAB = 1.6
"""A layer with this many times the cells of the median layer is a floor or a ceiling."""
SPOT, COVERS = 3, 0.7
"""Squares of 8 cells are spots of the ground; a ceiling has at least this share of its cells above others."""
STRAY = 0.005
"""This share of the cells at the bottom, and at the top, is ignored as reflections."""


def turned(points: ArrayLike, up: str) -> NDArray[np.float64]:
    """Return points (..., 3) of a map in the axes of its picture: right, away, up."""
    points = np.asarray(points, float)[..., list(UPS[up])]
    return points * [1, 1, -1] if up.startswith("-") else points


def turned_cells(cells: NDArray[np.int32], up: str) -> NDArray[np.int32]:
    """Return cells (N, 3) of a map in the axes of its picture; `up` is a key of `UPS`."""
    cells = cells[:, list(UPS[up])]
    if up.startswith("-"):
        cells[:, 2] = -1 - cells[:, 2]
    return cells


def ceiling(occupied: NDArray[np.int32]) -> int:
    """Return the layer (third index) at which the ceiling of occupied cells (K, 3) begins; beyond the highest if none.

    A ceiling is a layer in the upper part of the map, with and without its stray cells, with far more cells than
    usual layers. Most of the cells from there up must be above others: on a slope the ground of the upper part is not.
    """
    if not len(occupied):
        return 0
    low, count = layers(occupied)
    first, end = usual_layers(count)
    upper = np.arange(len(count)) > max(0.55 * len(count), first + 0.55 * (end - first))
    slabs = np.flatnonzero(upper & (count > SLAB * np.median(count[first:end])))
    cut = int(low + (slabs[0] - 1 if len(slabs) else len(count)))
    spots = occupied[:, :2] >> SPOT
    spots = (spots[:, 0].astype(np.int64) << 32) + spots[:, 1]
    above = occupied[:, 2] >= cut
    covers = np.isin(spots[above], spots[~above])
    return cut if covers.sum() >= COVERS * len(covers) else int(low + len(count))


def usual_layers(count: NDArray[np.int64]) -> tuple[int, int]:
    """Return the first layer and the one after the last that have more than stray cells below, and above them.

    Args:
        count: Number of cells of each layer, one at least.
    """
    below = np.cumsum(count)
    first, last = np.searchsorted(below, [STRAY * below[-1], (1 - STRAY) * below[-1]], side="right")
    return int(first), int(min(last, len(count) - 1)) + 1


def layers(cells: NDArray[np.int32]) -> tuple[int, NDArray[np.int64]]:
    """Return the lowest layer (third index) of cells (N, 3), N > 0, and the number of cells in each from there up."""
    low = int(cells[:, 2].min())
    return low, np.bincount(cells[:, 2] - low)
