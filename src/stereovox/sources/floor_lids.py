# SPDX-License-Identifier: Apache-2.0
"""Tops and undersides of things as a camera sees them: what a 3-D map has inside of the rims of a floor's things.

A camera that is lower than a table looks at its underside, so a map in three dimensions has the whole table, and so has
its projection. Beams in one plane find nothing but the rim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stereovox.maps.occupancy import OccupancyGrid
from stereovox.sources.floor_plan import Thing

OCCUPIED, FREE = 100, 0


def with_lids(grid: OccupancyGrid, things: Sequence[Thing], heights: tuple[float, float], eye: float) -> OccupancyGrid:
    """Return a perfect map of a floor with all lids occupied that lie between `heights` and can be seen.

    grid: what `FloorPlan.truth` returns, in the plan's frame. eye: height of the camera over the floor. A lid is an
    underside above the eye or a top below it. Not seen: what stands on another thing or carries one there, and what
    stands nowhere beside a free cell. Nothing that is free in `grid` changes.
    """
    from scipy import ndimage

    beside = np.asarray(ndimage.binary_dilation(grid.cells == FREE, np.ones((5, 5))), bool)
    inside = [_inside(thing, grid) for thing in things]
    seen = np.zeros(grid.cells.shape, bool)
    for thing, here in zip(things, inside, strict=True):
        height = lid(thing, eye)
        if height is None or not heights[0] <= height <= heights[1] or not (here & beside).any():
            continue
        open_ = here.copy()
        for other, there in zip(things, inside, strict=True):
            if other is not thing and other.low <= height <= other.high:
                open_ &= ~there
        seen |= open_
    return replace(grid, cells=np.where(seen & (grid.cells != FREE), np.int8(OCCUPIED), grid.cells))


def lid(thing: Thing, eye: float) -> float | None:
    """Return the height of the underside or top that a camera at the height `eye` looks at; None beside the thing."""
    if thing.low > eye:
        return thing.low
    return thing.high if thing.high < eye else None


def _inside(thing: Thing, grid: OccupancyGrid) -> NDArray[np.bool_]:
    """Tell which cells' middles lie within a thing's outline, (rows, columns)."""
    rows, columns = grid.cells.shape
    x = grid.origin[0] + (np.arange(columns) + 0.5) * grid.resolution
    y = grid.origin[1] + (np.arange(rows)[:, None] + 0.5) * grid.resolution
    inside = np.ones(grid.cells.shape, bool)
    for x0, y0, x1, y1 in thing.outline:  # the body is on the left of each side
        inside &= (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) >= 0
    return inside
