# SPDX-License-Identifier: Apache-2.0
"""The search for the floor among a map's surfaces: one level per column.

A surface has room for a robot above it and was seen from above. Surfaces grow together from cell to cell; the floor is
the lowest large group under the camera, and its continuation beyond gaps. Three kinds are rejected: surfaces that rise
too fast above lower floor nearby (furniture whose noise reads as a stair), surfaces under another storey that the
camera is on, and surfaces with much deeper free space next to them (a table whose floor was not seen).
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stereovox.products.floor.ground_surfaces import (
    BESIDE,
    LARGE,
    NO_SURFACE,
    TIE,
    Floor,
    add_islands,
    nearest_surface,
    one_level,
)
from stereovox.products.neighbours import components

ROOM = 1.8
"""Metres above a floor in which nothing is occupied: as high as the default of `scan.heights`."""
STEP = 0.1
"""Highest step in metres of a floor; at least one cell."""
GROWTH = 0.05
"""Metres by which neighbouring cells of one surface may differ; at least one cell."""
AREA = 1.0
"""Square metres above which any surface is large; only large ones may be a step apart."""
LEAST = 0.25
"""Least area of a floor in square metres."""
STEEPEST = 0.4
"""Steepest floor, rise over run: 22 degrees."""
RADII = (0.15, 0.25, 0.5, 1.0, 2.0)
"""Metres within which that slope is checked, above a step."""
NEAR = 3.0
"""Horizontal metres around the camera in which its floor is searched first."""
COVERED = 0.5
"""A floor is another storey if this share of it near the camera lies under a higher floor below the camera."""
DEEP, RIM, HOLLOW = 0.3, 1.0, 0.5
"""A surface is rejected if columns within RIM metres with free cells DEEP metres lower exceed HOLLOW times its own."""
BESIDE_M, MOST_DEEP = 0.25, 0.3
"""A small surface is rejected if more than this share of it has deeper free space within this many metres."""
ROUNDS = 4
"""Most extensions of a floor beyond gaps."""


class FloorSearch:
    """The surfaces of a map, and the search for its floor among them.

    Args:
        floor: The map's columns.
        start: (3,) row, column and level in cells of a place near the wanted floor; None: search for it.
        camera: The same of the camera; None: unknown.
    """

    def __init__(
        self, floor: Floor, start: NDArray[np.float64] | None = None, camera: NDArray[np.float64] | None = None
    ):
        self._floor, self._start, self._camera = floor, start, camera
        self._here = camera if start is None else start
        self._climb = max(1, int(GROWTH / floor.side + TIE))
        self._step = max(1, int(STEP / floor.side + TIE))

    def levels(self) -> NDArray[np.int64]:
        """Return the level (rows, columns) in cells of the floor's upper face; NO_SURFACE if it was not seen."""
        surfaces = self._floor.surfaces(ROOM, max(STEP, self._floor.side))
        first = self._grown(surfaces)
        kept = first[tuple(surfaces[:, :2].T)] == surfaces[:, 2]
        return self._grown(surfaces[kept & ~self._leaks(first)[tuple(surfaces[:, :2].T)]])

    def _grown(self, surfaces: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the floor among surfaces (N, 3) row, column, level: the group it starts from, and its islands."""
        group = components(surfaces, [(i, j, rise) for i, j in BESIDE for rise in range(-self._climb, self._climb + 1)])
        first = self._first(surfaces, group)
        if first is None:
            return np.full(self._floor.shape, NO_SURFACE, np.int64)
        levels = one_level(self._floor.shape, surfaces[group == first], self._here)
        large = self._large(group, AREA)
        allowed = np.where(large, self._step, np.where(self._stands(surfaces, group), -1, self._climb))
        for _ in range(ROUNDS):
            before = np.count_nonzero(levels == NO_SURFACE)
            add_islands(levels, surfaces, group, allowed, self._here)
            if np.count_nonzero(levels == NO_SURFACE) == before:
                break
        return levels

    def _first(self, surfaces: NDArray[np.int64], group: NDArray[np.int32]) -> int | None:
        """Return the group that the floor starts from, None if no surface qualifies."""
        if not len(surfaces):
            return None
        if self._start is not None:
            return int(group[nearest_surface(self._floor, surfaces, self._start)])
        size = np.bincount(group)
        large = self._large(group, max(LEAST, min(AREA, LARGE * size.max() * self._floor.resolution**2)))
        near = self._near(surfaces) & large[group]
        candidates = near if near.any() else large[group]
        mean = np.bincount(group, surfaces[:, 2]) / size
        for one in sorted(np.unique(group[candidates]).tolist(), key=lambda which: mean[which]):
            mine = surfaces[group == one]
            if not self._is_covered(surfaces[near & (group == one)], surfaces[near]) and not self._is_hollow(mine):
                return one
        return None

    def _stands(self, surfaces: NDArray[np.int64], group: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return which groups are above something lower: a box next to a floor as high as its top."""
        from scipy.ndimage import minimum_filter

        window = 2 * max(1, round(BESIDE_M / self._floor.resolution)) + 1
        lowest = minimum_filter(self._lowest_free, window, mode="nearest")[tuple(surfaces[:, :2].T)]
        deep = (lowest < surfaces[:, 2] - 1 - self._step).astype(float)
        return np.bincount(group, deep) > MOST_DEEP * np.bincount(group)

    def _large(self, group: NDArray[np.int32], area: float) -> NDArray[np.bool_]:
        """Return which groups have at least `area` square metres."""
        return np.bincount(group) * self._floor.resolution**2 >= area

    def _near(self, surfaces: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which surfaces lie below the camera and near it."""
        if self._camera is None:
            return np.zeros(len(surfaces), bool)
        away = np.linalg.norm(surfaces[:, :2] + 0.5 - self._camera[:2], axis=1) * self._floor.resolution
        return (away <= NEAR) & (surfaces[:, 2] < self._camera[2])

    def _is_covered(self, mine: NDArray[np.int64], others: NDArray[np.int64]) -> bool:
        """Return whether a floor near the camera lies mostly under other surfaces."""
        if not len(mine):
            return False
        top = np.full(self._floor.shape, -NO_SURFACE, np.int64)
        np.maximum.at(top, tuple(others[:, :2].T), others[:, 2])
        above = top[tuple(mine[:, :2].T)] - mine[:, 2]
        return bool(np.mean(above > ROOM / self._floor.side) > COVERED)

    def _is_hollow(self, mine: NDArray[np.int64]) -> bool:
        """Return whether much free space lies deeper than a surface, next to it."""
        from scipy.ndimage import distance_transform_edt

        levels = one_level(self._floor.shape, mine, self._here)
        away, nearest = map(np.asarray, distance_transform_edt(levels == NO_SURFACE, return_indices=True) or ())
        run = away * self._floor.resolution
        depth = (levels[tuple(nearest)] - self._lowest_free) * self._floor.side - STEEPEST * run
        hollow = (run > 0) & (run <= RIM) & (depth > DEEP)
        return bool(np.count_nonzero(hollow) > HOLLOW * np.count_nonzero(levels != NO_SURFACE))

    def drops(self, height: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return the mask of free space deeper than a step below a floor at levels (rows, columns): no floor there."""
        return self._lowest_free < height - 1 - self._step

    @cached_property
    def _lowest_free(self) -> NDArray[np.int64]:
        """Bottom level (rows, columns) of the lowest free cell; NO_SURFACE if nothing is free."""
        floor = self._floor
        free = np.floor(floor.voxel_map.free() / floor.voxel_map.config.cell).astype(np.int64)
        x, y, up = free[:, floor.axes].T
        lowest = np.full(floor.shape, NO_SURFACE, np.int64)
        np.minimum.at(lowest, (y - floor.first[1], x - floor.first[0]), up if floor.sign > 0 else -1 - up)
        return lowest

    def _leaks(self, levels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return the mask of floor (rows, columns) that rises too fast above lower floor nearby."""
        from scipy.ndimage import minimum_filter

        leaks = np.zeros(levels.shape, bool)
        for radius in RADII:
            window = 2 * max(1, round(radius / self._floor.resolution)) + 1
            lowest = minimum_filter(levels, window, mode="nearest")
            leaks |= (levels - lowest - self._step) * self._floor.side > STEEPEST * radius
        return leaks
