# SPDX-License-Identifier: Apache-2.0
"""The height of the ground, and where a robot can drive on it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import IntEnum
from math import isfinite, radians, tan
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import replacing
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.products.floor.ground_surfaces import Floor, floor_of, ground_levels

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
