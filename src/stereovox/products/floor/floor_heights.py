# SPDX-License-Identifier: Apache-2.0
"""The height of the floor at each place of a map, or unknown: the reference for heights in all 2-D products.

A map's world may begin anywhere: z = 0 of a tracked map is where the camera began. So robot heights are never
measured from the world's origin, unless a user states the height of the floor there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.kernels.threads import one_state
from stereovox.maps import VoxelMap
from stereovox.products.floor.floor_axes import Heights, check_level, floor_axes
from stereovox.products.floor.floor_search import FloorSearch
from stereovox.products.floor.ground_surfaces import NO_SURFACE, floor_of, place_of

REACH = 0.5
"""Metres from the nearest observed floor within which its height applies."""
NO_FLOOR = "the map shows no floor, so heights above it are unknown and nothing is free"
CURE = "let the camera see the floor, or state its height in the world: --set scan.floor=Z (export: --floor Z), metres"
TIE = 1e-4
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
        columns, rows = np.floor((across - self.origin[:2]) / self.resolution + TIE).astype(np.int64).T
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
        lowest = np.maximum(np.floor((floor + heights[0]) / side + TIE), np.floor(floor / side + TIE) + 1)
        top = np.ceil((floor + heights[1]) / side - TIE) - 1
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
