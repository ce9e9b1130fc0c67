# SPDX-License-Identifier: Apache-2.0
"""One spherical grid of several: those of all cameras, or an older one after the vehicle has moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np

from stereovox.depth.sphere_grid import ARRAYS, RANK, SphereGrid, empty
from stereovox.depth.sphere_layout import SphereLayout, union
from stereovox.frame import Reason
from stereovox.geometry import Transform, transform_points
from stereovox.rigs import VirtualCamera
from stereovox.sensors.noise import SUBPIXEL


def stitch(grids: Sequence[SphereGrid]) -> SphereGrid:
    """Return one grid of several: in each direction the nearest wins and keeps its age (Valenti 2018, 5.4).

    A surface wins against what is only known to be free up to somewhere; at equal ranges the newest wins. Bounds may
    differ. Raises ConfigError where steps differ.
    """
    layout = union([grid.layout for grid in grids])
    return reduce(_nearer, (_widened(grid, layout) for grid in grids), empty(layout))


def moved(grid: SphereGrid, T_new_old: Transform) -> SphereGrid:
    """Return the grid as the body sees it after it has moved; T_new_old (4, 4) maps its old frame into the new one.

    Each range is taken to where it stands now and keeps its age; what fell between two cells is unknown. For moves that
    are small against the ranges: what the vehicle could not see round from its old place is not known either.
    """
    seen = grid.known & (grid.reason != Reason.TOO_NEAR)
    points = transform_points(T_new_old, grid.layout.directions()[seen] * grid.range_m[seen, None])
    ranges = np.linalg.norm(points, axis=1)
    values = {"range_m": ranges, **{name: getattr(grid, name)[seen] for name in ARRAYS[1:]}}
    order = np.lexsort((-ranges, -RANK[values["reason"]].astype(int)))  # what wins is written last
    place = grid.layout.cells_of(points)
    order = order[place[order] >= 0]
    into = empty(grid.layout)
    for name in ARRAYS:
        getattr(into, name).reshape(-1)[place[order]] = values[name][order]
    return replace(into, camera=grid.camera)


def _widened(grid: SphereGrid, layout: SphereLayout) -> SphereGrid:
    """Return the grid with other bounds, which hold its own."""
    if grid.layout == layout:
        return grid
    into = empty(layout)
    place = np.ix_(*grid.layout.places_in(layout))
    for name in ARRAYS:
        getattr(into, name)[place] = getattr(grid, name)
    return replace(into, camera=grid.camera)


def _nearer(a: SphereGrid, b: SphereGrid) -> SphereGrid:
    rank_a, rank_b = (RANK[grid.reason] for grid in (a, b))
    nearer = (rank_b < rank_a) | ((rank_b == rank_a) & (b.range_m < a.range_m))  # false for NaN, which is unknown
    take = nearer | ((rank_b == rank_a) & (b.range_m == a.range_m) & (b.stamp_ns > a.stamp_ns))
    arrays = {name: np.where(take, getattr(b, name), getattr(a, name)) for name in ARRAYS}
    return replace(a, **arrays, camera=max(a.camera, b.camera, key=_noise))


def _noise(camera: VirtualCamera | None) -> float:
    """Return how fast the noise of a camera's depths grows with the square of the depth; -1 where nobody knows."""
    if camera is None or camera.baseline is None:
        return -1.0 if camera is None else 0.0
    return (camera.subpixel or SUBPIXEL) / (camera.focal_px * camera.baseline)
