# SPDX-License-Identifier: Apache-2.0
"""Surfaces that can be stood on, and the ground among them."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import State, VoxelMap
from stereovox.maps.storage.cubes import in_cubes
from stereovox.products.block_pairs import in_memory
from stereovox.products.floor.floor_axes import MAX_CELLS, floor_axes
from stereovox.products.neighbours import components

TIE = 1e-6
"""Rounding tolerance in cells."""
NO_SURFACE = 2**40
"""Level, in cells, of a column without a surface."""
LARGE = 0.25
"""Least size of a floor as a share of the largest surface: tables may be seen better than floors."""
BESIDE = ((1, 0), (0, 1), (1, 1), (1, -1))
"""Half of the eight columns next to one."""


@dataclass(frozen=True, eq=False)
class Floor:
    """The columns of cells of a map, as a picture from above just large enough for the known cells.

    axes, sign: see `floor_axes`. first: (2,) lowest column and row in cells; shape: rows, columns. resolution: side of
    a cell across the floor; side: its height along `up`.
    """

    voxel_map: VoxelMap
    axes: tuple[int, int, int]
    sign: int
    first: NDArray[np.int64]
    shape: tuple[int, int]
    resolution: float
    side: float

    @property
    def origin(self) -> tuple[float, float, float]:
        """x, y, yaw of the lower left corner in metres."""
        x, y = (self.first * self.resolution).round(9).tolist()
        return x, y, 0.0

    def points(self, rows: ArrayLike, columns: ArrayLike, heights: ArrayLike) -> NDArray[np.float64]:
        """Return places (N, 3) in metres, world frame; rows and columns in cells; 0.5 is the middle of the first."""
        rows, columns, heights = np.broadcast_arrays(rows, columns, heights)
        points = np.empty((rows.size, 3))
        points[:, self.axes[0]] = (columns + self.first[0]) * self.resolution
        points[:, self.axes[1]] = (rows + self.first[1]) * self.resolution
        points[:, self.axes[2]] = heights * self.sign
        return points

    def surfaces(self, height: float, step: float) -> NDArray[np.int64]:
        """Return row, column and level (N, 3), in cells, of upper faces with `height` metres of room above them.

        Nothing is occupied there; a free cell begins no more than `step` metres above the face, so that it was seen.
        """
        occupied = np.floor(self.voxel_map.occupied() / self.voxel_map.config.cell).astype(np.int64)
        x, y, up = occupied[:, self.axes].T
        level = up + 1 if self.sign > 0 else -up
        cells = np.column_stack([y - self.first[1], x - self.first[0], level])
        cells = cells[np.lexsort(cells.T[::-1])]
        same = (cells[1:, :2] == cells[:-1, :2]).all(axis=1)
        crowded = same & (np.diff(cells[:, 2]) - 1 < ceil(height / self.side - TIE))
        return self._seen(cells[~np.append(crowded, False)[: len(cells)]], step)

    def _seen(self, cells: NDArray[np.int64], step: float) -> NDArray[np.int64]:
        rows, columns, levels = cells.T
        seen = np.zeros(len(cells), bool)
        for above in range(int(step / self.side + TIE) + 1):
            middles = self.points(rows + 0.5, columns + 0.5, (levels + above + 0.5) * self.side)
            seen |= self.voxel_map.state(middles) == State.FREE
        return cells[seen]


def floor_of(voxel_map: VoxelMap) -> Floor:
    """Return the columns of a map; raises StereovoxError if nothing is known, or they are too many."""
    voxel_map = in_memory(voxel_map)
    x, y, up, sign = floor_axes(voxel_map.config.up)
    if voxel_map.config.cell[x] != voxel_map.config.cell[y]:
        voxel_map = in_cubes(voxel_map)
    bounds, cell = voxel_map.bounds(), voxel_map.config.cell
    if bounds is None:
        raise StereovoxError("the map is empty: it has no floor")
    low, high = np.rint(bounds[:, [x, y]] / cell[x]).astype(np.int64)
    columns, rows = (high - low).tolist()
    if rows * columns > MAX_CELLS:
        raise StereovoxError(f"a floor of {columns} x {rows} cells is too large; take a part of it: stereovox crop")
    return Floor(voxel_map, (x, y, up), sign, low, (rows, columns), cell[x], cell[up])


def ground_levels(
    floor: Floor, height: float, step: float, start: ArrayLike | None
) -> tuple[np.ma.MaskedArray, NDArray[np.int64]]:
    """Return the level of the ground (rows, columns) in cells, masked if there is none, and of the lowest surface.

    Columns at NO_SURFACE have no surface at all. Raises StereovoxError if there is no ground.
    """
    surfaces = floor.surfaces(height, step)
    if not len(surfaces):
        raise StereovoxError(
            f"the map has no ground: nothing occupied with {height:g} m free above it; is the map's `up` right?"
        )
    climb = int(step / floor.side + TIE)
    group = components(surfaces, [(i, j, rise) for i, j in BESIDE for rise in range(-climb, climb + 1)])
    here = None if start is None else place_of(floor, start)
    first = _lowest_large(surfaces, group) if here is None else group[nearest_surface(floor, surfaces, here)]
    levels = one_level(floor.shape, surfaces[group == first], here)
    add_islands(levels, surfaces, group, climb, here)
    return np.ma.masked_equal(levels, NO_SURFACE), one_level(floor.shape, surfaces, None)


def place_of(floor: Floor, start: ArrayLike) -> NDArray[np.float64]:
    """Return row, column and level of a place in metres, not rounded."""
    place = np.asarray(start, float)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise StereovoxError(f"start {start}: give a point X, Y, Z in metres")
    x, y, up = place[list(floor.axes)]
    return np.array([y / floor.resolution - floor.first[1], x / floor.resolution - floor.first[0],
                     up * floor.sign / floor.side])  # fmt: skip


def _lowest_large(surfaces: NDArray[np.int64], group: NDArray[np.int32]) -> np.intp:
    """Return the group with the lowest mean among those large enough for a floor."""
    size = np.bincount(group)
    mean = np.bincount(group, surfaces[:, 2]) / size
    return np.argmin(np.where(size >= LARGE * size.max(), mean, np.inf))


def nearest_surface(floor: Floor, surfaces: NDArray[np.int64], here: NDArray[np.float64]) -> np.intp:
    """Return the index of the surface nearest to a place."""
    away = (surfaces + np.array([0.5, 0.5, 0]) - here) * [floor.resolution, floor.resolution, floor.side]
    return np.argmin((away**2).sum(axis=1))


def one_level(
    shape: tuple[int, ...], surfaces: NDArray[np.int64], here: NDArray[np.float64] | None
) -> NDArray[np.int64]:
    """Return one level (rows, columns) of the surfaces in each column: nearest in height to a place, or the lowest."""
    order = np.argsort(-surfaces[:, 2] if here is None else -np.abs(surfaces[:, 2] - here[2]), kind="stable")
    levels = np.full(shape, NO_SURFACE, np.int64)
    rows, columns, heights = surfaces[order].T
    levels[rows, columns] = heights  # of several the last one wins
    return levels


def add_islands(
    levels: NDArray[np.int64],
    surfaces: NDArray[np.int64],
    group: NDArray[np.int32],
    climb: int | NDArray[np.integer],
    here: NDArray[np.float64] | None,
) -> None:
    """Add to `levels` the groups of surfaces at most `climb` higher or lower than the nearest ground.

    climb: in cells, for all groups or (groups,) for each.
    """
    from scipy.ndimage import distance_transform_edt

    away, nearest = map(np.asarray, distance_transform_edt(levels == NO_SURFACE, return_indices=True) or ())
    rows, columns, heights = surfaces.T
    run, rise = away[rows, columns], np.abs(heights - levels[tuple(nearest[:, rows, columns])])
    order = np.lexsort((rise, run))  # the nearest of each group first
    _, firsts = np.unique(group[order], return_index=True)
    level = rise[order[firsts]] <= climb
    more = one_level(levels.shape, surfaces[level[group]], here)
    np.copyto(levels, more, where=levels == NO_SURFACE)
