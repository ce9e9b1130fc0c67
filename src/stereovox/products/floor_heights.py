# SPDX-License-Identifier: Apache-2.0
"""The search for the floor among a map's surfaces: one level per column.

A surface has room for a robot above it and was seen from above. Surfaces grow together from cell to cell; the floor is
the lowest large group under the camera, and its continuation beyond gaps. Three kinds are rejected: surfaces that rise
too fast above lower floor nearby (furniture whose noise reads as a stair), surfaces under another storey that the
camera is on, and surfaces with much deeper free space next to them (a table whose floor was not seen).

The height of the floor at each place of a map, or unknown: the reference for heights in all 2-D products.

A map's world may begin anywhere: z = 0 of a tracked map is where the camera began. So robot heights are never
measured from the world's origin, unless a user states the height of the floor there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.kernels.threads import one_state
from stereovox.maps import VoxelMap
from stereovox.products.blocks import components
from stereovox.products.floor_axes import Heights, check_level, floor_axes
from stereovox.products.ground import (
    BESIDE,
    LARGE,
    NO_SURFACE,
    TIE,
    Floor,
    add_islands,
    floor_of,
    nearest_surface,
    one_level,
    place_of,
)

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


REACH = 0.5
"""Metres from the nearest observed floor within which its height applies."""
NO_FLOOR = "the map shows no floor, so heights above it are unknown and nothing is free"
CURE = "let the camera see the floor, or state its height in the world: --set scan.floor=Z (export: --floor Z), metres"
HEIGHT_TIE = 1e-4
"""Rounding tolerance in cells."""
SMOOTHED = 5
"""Side in cells of the square whose median is a floor's height: one noisy cell does not lift it."""


@dataclass(frozen=True, eq=False)
class FloorHeights:
    """The height of the floor at each place of a map, seen from above; row 0 and column 0 are the lowest.

    Attributes:
        height: (rows, columns) float32, metres along the map's `up` from the world's origin, of the nearest observed
            floor. NaN if there is no floor.
        away: (rows, columns) float32, horizontal metres to that floor; 0 if observed here, infinite if free space lies
            deeper, as beyond the edge of a drop.
        resolution: Side of a cell in metres.
        origin: x, y, yaw of the corner of cell (0, 0), in the axes of `projection.project`.
        up: The axis of the map that points up.
        elsewhere: Height in metres of a floor stated to be level everywhere; NaN if the floor was found.
    """

    height: NDArray[np.float32]
    away: NDArray[np.float32]
    resolution: float
    origin: tuple[float, float, float]
    up: str
    elsewhere: float = float("nan")

    @classmethod
    def level(cls, height: float, up: str = "z") -> FloorHeights:
        """Return a floor that the user states to be level everywhere.

        Args:
            height: Metres along `up` from the world's origin.
            up: The axis of the map that points up.

        Raises:
            StereovoxError: The height is not finite.
        """
        if not np.isfinite(height):
            raise StereovoxError(f"floor {height}: give the height of the floor in metres from the world's origin")
        nothing = np.empty((0, 0), np.float32)
        return cls(nothing, nothing, 1.0, (0.0, 0.0, 0.0), up, float(height))

    @classmethod
    def unknown(cls, up: str = "z") -> FloorHeights:
        """Return a floor of unknown height everywhere."""
        nothing = np.empty((0, 0), np.float32)
        return cls(nothing, nothing, 1.0, (0.0, 0.0, 0.0), up)

    @property
    def known(self) -> bool:
        """Whether the height is known anywhere."""
        return bool(np.isfinite(self.elsewhere) or np.isfinite(self.height).any())

    def at(self, points: ArrayLike, reach: float = REACH) -> NDArray[np.float64]:
        """Return the height of the floor below or above points.

        Args:
            points: (N, 3) metres, world frame.
            reach: Metres from the nearest observed floor within which its height applies.

        Returns:
            (N,) metres along `up` from the world's origin; NaN if the floor is unknown there.
        """
        x, y, _, _ = floor_axes(self.up)
        across = np.asarray(points, float).reshape(-1, 3)[:, [x, y]]
        columns, rows = np.floor((across - self.origin[:2]) / self.resolution + HEIGHT_TIE).astype(np.int64).T
        height, away = self._nearest(rows, columns)
        return np.where(away <= reach, height, np.nan)

    def layers(
        self, low: NDArray[np.int64], high: NDArray[np.int64], config: Config, heights: Heights
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.bool_]]:
        """Return the layers of a map's cells within a range of heights above the floor.

        Args:
            low: (2,) first column and row, in cells of the map.
            high: (2,) column and row after the last.
            config: Settings of the map.
            heights: Lowest and highest metres above the floor. A cell that overlaps this range counts, but never the
                cell that contains the floor itself.

        Returns:
            First and last layer (rows, columns) int32 along the map's axis, the first above the last if no floor is
            known; and whether a floor was observed within REACH (rows, columns).
        """
        _, _, up, sign = floor_axes(self.up)
        side = config.cell[up]
        height, away = self._within(low, high)
        known = ~np.isnan(height)
        floor = np.where(known, height, 0.0)
        lowest = np.maximum(np.floor((floor + heights[0]) / side + HEIGHT_TIE), np.floor(floor / side + HEIGHT_TIE) + 1)
        top = np.ceil((floor + heights[1]) / side - HEIGHT_TIE) - 1
        lowest, top = (lowest, top) if sign > 0 else (-1 - top, -1 - lowest)
        limits = np.iinfo(np.int32).min // 2, np.iinfo(np.int32).max // 2
        lowest, top = (np.clip(ends, *limits).astype(np.int32) for ends in (lowest, top))
        return np.where(known, lowest, limits[1]).astype(np.int32), top, known & (away <= REACH)

    def moved_from(self, before: FloorHeights) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
        """Return the first column and row, and the ones after the last, in cells of the map, of the region where the
        floor changed; None if nothing changed."""
        boxes = [one._box() for one in (self, before) if one.height.size]
        if not boxes:
            return None
        low, high = np.min([box[0] for box in boxes], axis=0), np.max([box[1] for box in boxes], axis=0)
        (height, away), (height_before, away_before) = (one._within(low, high) for one in (self, before))
        other = (height != height_before) & ~(np.isnan(height) & np.isnan(height_before))
        other |= (away <= REACH) != (away_before <= REACH)
        rows, columns = (np.flatnonzero(other.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            return None
        return low + np.array([columns[0], rows[0]]), low + np.array([columns[-1], rows[-1]]) + 1

    def _box(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return first column and row of the picture in cells of the map, and the ones after the last."""
        first = np.rint(np.array(self.origin[:2]) / self.resolution).astype(np.int64)
        return first, first + self.height.shape[::-1]

    def _within(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> tuple[NDArray[np.float64], ...]:
        """Return the nearest height and its distance (rows, columns) in a box of columns of the map."""
        first, _ = self._box()
        rows, columns = np.ogrid[low[1] - first[1] : high[1] - first[1], low[0] - first[0] : high[0] - first[0]]
        return self._nearest(*np.broadcast_arrays(rows, columns))

    def _nearest(
        self, rows: NDArray[np.int64], columns: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the height of the nearest observed floor, NaN if none, and its distance in metres.

        rows, columns: of one shape, in cells of this picture; they may be outside it.
        """
        if not self.height.size:
            return np.full(rows.shape, self.elsewhere), np.zeros(rows.shape)
        inside = tuple(np.clip(at, 0, n - 1) for at, n in zip((rows, columns), self.height.shape, strict=True))
        outside = np.hypot(rows - inside[0], columns - inside[1]) * self.resolution
        return self.height[inside].astype(float), self.away[inside] + outside


def floor_of_map(
    voxel_map: VoxelMap, stated: FloorHeights | float | None = None, start: ArrayLike | None = None
) -> FloorHeights:
    """Return the floor of a map: the level floor that is stated here or in `scan.floor`, or else the one found.

    Args:
        voxel_map: The map.
        stated: Metres along the map's `up` from the world's origin, or a floor found before; None:
            `scan.floor`.
        start: See `find_floor`; if given, the floor is searched.

    Raises:
        StereovoxError: As `find_floor`.
    """
    if isinstance(stated, FloorHeights):
        return stated
    config = voxel_map.config
    stated = config.scan.floor if stated is None and start is None else stated
    return find_floor(voxel_map, start) if stated is None else FloorHeights.level(stated, config.up)


def known_floor(
    voxel_map: VoxelMap, stated: FloorHeights | float | None = None, start: ArrayLike | None = None
) -> FloorHeights:
    """Return the floor as `floor_of_map`; raises StereovoxError, with the cure, if its height is known nowhere."""
    floor = floor_of_map(voxel_map, stated, start)
    if not floor.known:
        raise StereovoxError(f"{NO_FLOOR}; {CURE}")
    return floor


@one_state
def find_floor(voxel_map: VoxelMap, start: ArrayLike | None = None) -> FloorHeights:
    """Find the floor of a map: heights per cell, so that it may slope and have steps of up to 0.1 m.

    The floor is the lowest large surface near and below the camera of the last frame, with room for 1.8 m above it, and
    its continuation (`floor_search`). Unobserved cells take the nearest floor's height, with its distance.

    Args:
        voxel_map: The map.
        start: (3,) metres, near the wanted floor, if there are several storeys or steps.

    Returns:
        The floor's height in each cell, unknown everywhere if the map shows no floor.

    Raises:
        StereovoxError: The map is too large or not level, or `start` is invalid.
    """
    from scipy.ndimage import distance_transform_edt, median_filter

    check_level(voxel_map.config)
    if voxel_map.bounds() is None:
        return FloorHeights.unknown(voxel_map.config.up)
    floor, viewpoint = floor_of(voxel_map), voxel_map.viewpoint
    here = None if start is None else place_of(floor, start)
    camera = None if viewpoint is None else place_of(floor, viewpoint.T_world_camera[:3, 3])
    search = FloorSearch(floor, here, camera)
    levels = search.levels()
    if (levels == NO_SURFACE).all():
        return FloorHeights.unknown(voxel_map.config.up)
    away, nearest = map(np.asarray, distance_transform_edt(levels == NO_SURFACE, return_indices=True) or ())
    filled = levels[tuple(nearest)]
    away[(levels == NO_SURFACE) & search.drops(filled)] = np.inf
    height = (median_filter(filled, SMOOTHED, mode="nearest") - 0.5) * floor.side
    return FloorHeights(
        height.astype(np.float32), (away * floor.resolution).astype(np.float32), floor.resolution, floor.origin,
        voxel_map.config.up,
    )  # fmt: skip
