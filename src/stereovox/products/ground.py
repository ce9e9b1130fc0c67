# SPDX-License-Identifier: Apache-2.0
"""Surfaces that can be stood on, and the ground among them.

The height of the ground, and where a robot can drive on it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import IntEnum
from math import ceil, isfinite, radians, tan
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import replacing
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.maps.storage.cubes import in_cubes
from stereovox.products.blocks import components, in_memory
from stereovox.products.floor_axes import MAX_CELLS, floor_axes

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


MIN_REACH = 2
"""Fewest cells on each side over which a slope is fitted, because heights are whole cells."""
MARGIN = 1e-3
"""Share of a cell by which query boxes stay clear of neighbouring cells."""
PERCENT = np.array([UNKNOWN, 0, 50, 100, 100, 100, 100], np.int8)
"""The occupancy of each `Footing`."""


@one_state
def ground(voxel_map: VoxelMap, robot: Robot | None = None, start: ArrayLike | None = None) -> Ground:
    """Find the ground and where a robot can drive on it.

    Ground is occupied, has a free cell above it within a step, and nothing occupied within the robot's height. It grows
    from a seed surface to all surfaces that differ by at most a step from one cell to the next; so a table top is no
    ground, and a ramp is. Ground beyond an unseen gap counts if it begins at most a step higher or lower. If floors
    overlap, the one nearest in height to `start` counts, or else the lower one.

    A cell is drivable if all room above the step is free, the slope (of the plane that fits best within the robot's
    radius) is not too steep, and no step is next to it. Where no ground was seen, an occupied cell within the robot's
    height above the nearest ground is an obstacle, and a surface more than a step below it a drop; all else is unknown.
    The robot's footprint is not included: inflate the grid for that.

    Args:
        voxel_map: The map.
        robot: Size and abilities; None: a `Robot` of 1 m.
        start: (3,) metres, near the seed surface; None: the lowest of the large surfaces.

    Returns:
        Height and footing of each cell of the floor.

    Raises:
        StereovoxError: The map has no ground, is not level, or is too large.
    """
    robot = robot or Robot()
    floor = floor_of(voxel_map)
    levels, lower = ground_levels(floor, robot.height, robot.max_step, start)
    height = np.where(levels.mask, np.nan, levels.filled(0) * floor.side)
    footing = _on_ground(floor, height, robot)
    missing = np.isnan(height)
    footing[missing] = _off_ground(floor, height, lower, robot)[missing]
    return Ground(height.astype(np.float32), footing, floor.resolution, floor.origin)


@dataclass(frozen=True, eq=False)
class Ground:
    """The ground seen from above; row 0 and column 0 are the lowest.

    Attributes:
        height: (rows, columns) float32, metres along the map's `up`, of the upper face of the ground; NaN if none
            was seen.
        footing: (rows, columns) uint8 `Footing`.
        resolution: Side of a cell in metres.
        origin: x, y, yaw of the corner of cell (0, 0), in the axes of `project`.
    """

    height: NDArray[np.float32]
    footing: NDArray[np.uint8]
    resolution: float
    origin: tuple[float, float, float]

    @property
    def grid(self) -> OccupancyGrid:
        """Convert to an occupancy grid: 0 per cent drivable, 50 tentative, 100 not drivable, -1 unknown."""
        return OccupancyGrid(PERCENT[self.footing], self.resolution, self.origin)


@dataclass(frozen=True, eq=False)
class Robot:
    """Size and abilities of a robot, in metres and degrees.

    Attributes:
        height: Room it needs above the ground.
        radius: Distance around its centre over which the slope is fitted.
        max_step: Highest step it climbs, up or down; lower objects are no obstacles.
        max_slope_deg: Steepest ground.
    """

    height: float = 1.0
    radius: float = 0.25
    max_step: float = 0.1
    max_slope_deg: float = 20.0

    def __post_init__(self) -> None:
        if not (0 <= self.max_step < self.height and isfinite(self.height)):
            raise StereovoxError(f"max_step {self.max_step:g} must be 0 or more and less than height {self.height:g}")
        if not (0 < self.radius < np.inf and 0 < self.max_slope_deg < 90):
            raise StereovoxError(
                f"radius {self.radius:g} must be above 0, max_slope_deg {self.max_slope_deg:g} between 0 and 90"
            )


class Footing(IntEnum):
    """What a cell of the floor means to the robot."""

    UNKNOWN = 0
    DRIVABLE = 1
    TENTATIVE = 2  # something above the ground is tentative
    OBSTACLE = 3  # something stands or hangs there
    STEP = 4  # neighbouring ground is higher or lower by more than a step
    STEEP = 5
    DROP = 6  # the surface is lower by more than a step, and no path leads down


def write_ground(found: Ground, path: str | Path) -> None:
    """Write a `Ground` for `numpy.load`: its arrays, `resolution` in metres, and `origin` x, y, yaw.

    Raises MapFileError if the file cannot be written.
    """
    with replacing(path) as file:
        np.savez_compressed(file, **asdict(found))


def slopes(height: NDArray[np.float64], side: float, radius: float) -> NDArray[np.float64]:
    """Return the slope (rows, columns), rise over run, of the plane that best fits the heights around each cell.

    height: (rows, columns) metres, NaN if none. The square around a cell extends `radius` metres to each side, at
    least two cells. 0 if there is no height, or if the heights lie on one line of cells.
    """
    from scipy.ndimage import correlate1d

    reach = max(int(np.ceil(min(radius / side, max(height.shape)) - 1e-9)), MIN_REACH)  # nothing is farther off
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
    """Return the largest height difference (rows, columns) between each cell and its neighbours; 0 if none."""
    from scipy.ndimage import maximum_filter, minimum_filter

    known = ~np.isnan(height)
    highest = maximum_filter(np.where(known, height, -np.inf), 3, mode="nearest")
    lowest = minimum_filter(np.where(known, height, np.inf), 3, mode="nearest")
    here = np.where(known, height, 0.0)
    return np.where(known, np.maximum(highest - here, here - lowest), 0.0)


def _on_ground(floor: Floor, height: NDArray[np.float64], robot: Robot) -> NDArray[np.uint8]:
    """Return the `Footing` (rows, columns) on ground."""
    footing = np.array([Footing.UNKNOWN, Footing.DRIVABLE, Footing.TENTATIVE, Footing.OBSTACLE], np.uint8)[
        _room_above(floor, height, robot)
    ]
    footing[slopes(height, floor.resolution, robot.radius) > tan(radians(robot.max_slope_deg))] = Footing.STEEP
    footing[beside(height) > robot.max_step + MARGIN * floor.side] = Footing.STEP
    return footing


def _off_ground(floor: Floor, height: NDArray[np.float64], lower: NDArray[np.int64], robot: Robot) -> NDArray[np.uint8]:
    """Return the `Footing` (rows, columns) off the ground, relative to the nearest ground.

    lower: (rows, columns) the lowest surface there, in cells, the largest integer if there is none.
    """
    from scipy.ndimage import distance_transform_edt

    rows, columns = np.asarray(distance_transform_edt(np.isnan(height), return_distances=False, return_indices=True))
    near = height[rows, columns]
    above = _room_above(floor, near, robot)
    footing = np.where(above == State.OCCUPIED, Footing.OBSTACLE, Footing.UNKNOWN)
    footing[above == State.TENTATIVE] = Footing.TENTATIVE
    drop = (lower * floor.side < near - robot.max_step - MARGIN * floor.side) & (above != State.OCCUPIED)
    footing[drop] = Footing.DROP
    return footing.astype(np.uint8)


def _room_above(floor: Floor, height: NDArray[np.float64], robot: Robot) -> NDArray[np.uint8]:
    """Return the worst `State` (rows, columns) of the cells between a step and the robot's height above the ground."""
    worst = np.zeros(height.shape, np.uint8)
    rows, columns = np.nonzero(~np.isnan(height))
    over = height[rows, columns]
    low = floor.points(rows + MARGIN, columns + MARGIN, over + robot.max_step + MARGIN * floor.side)
    high = floor.points(rows + 1 - MARGIN, columns + 1 - MARGIN, over + robot.height - MARGIN * floor.side)
    worst[rows, columns] = floor.voxel_map.check_boxes(np.minimum(low, high), np.maximum(low, high))
    return worst
