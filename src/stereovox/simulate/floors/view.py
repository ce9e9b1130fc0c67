# SPDX-License-Identifier: Apache-2.0
"""Exact views of a simulated floor by a level camera and by a lidar.

For a level camera each column needs one ray on the plan, and for each obstacle the two points where that ray enters and
leaves its outline.

Lids are the visible tops and undersides: a 3-D map has them inside the outlines of obstacles. A camera lower
than a table sees its underside, so a 3-D map has the whole table, and so has its projection; beams in one plane
find only the outline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.geometry import se2
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.simulate.floors.plan import CEILING, FloorPlan, Obstacle

OCCUPIED, FREE = 100, 0
NONE = np.float32(np.inf)


def cast(
    segments: NDArray[np.float64], origin: ArrayLike, angles: ArrayLike, longest: float = np.inf
) -> NDArray[np.float64]:
    """Return the distance of rays from `origin` (2,) to the first segment, (N,) metres, inf if they meet none.

    segments: (M, 4) x, y from and to. angles: (N,) radians, 0 along x, to the left. longest: larger distances are inf.
    """
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    t = cast_along(within_reach(segments, origin, longest), origin, directions)
    return np.where(t <= longest, t, np.inf)


def cast_along(
    segments: NDArray[np.float64], origin: ArrayLike, directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the distance from `origin` (2,) to the first segment in units of `directions` (N, 2), (N,), inf if
    none."""
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
    """Return the segments that touch, at least nearly, the square of half width `reach` round `origin`."""
    x, y = np.asarray(origin, float)
    near = (np.minimum(segments[:, 0], segments[:, 2]) <= x + reach) & (
        np.maximum(segments[:, 0], segments[:, 2]) >= x - reach
    )
    near &= np.minimum(segments[:, 1], segments[:, 3]) <= y + reach
    near &= np.maximum(segments[:, 1], segments[:, 3]) >= y - reach
    return segments[near]


def with_lids(
    grid: OccupancyGrid, obstacles: Sequence[Obstacle], heights: tuple[float, float], eye: float
) -> OccupancyGrid:
    """Return a perfect map of a floor with all visible lids between `heights` occupied.

    grid: from `FloorPlan.truth`, in the plan's frame. eye: height of the camera above the floor. A lid is an
    underside above the eye or a top below it. Not visible: lids in contact with another obstacle, and those
    not next to a free cell. Free cells of `grid` do not change.
    """
    from scipy import ndimage

    beside = np.asarray(ndimage.binary_dilation(grid.cells == FREE, np.ones((5, 5))), bool)
    inside = [_inside(obstacle, grid) for obstacle in obstacles]
    seen = np.zeros(grid.cells.shape, bool)
    for obstacle, here in zip(obstacles, inside, strict=True):
        height = lid(obstacle, eye)
        if height is None or not heights[0] <= height <= heights[1] or not (here & beside).any():
            continue
        open_ = here.copy()
        for other, there in zip(obstacles, inside, strict=True):
            if other is not obstacle and other.low <= height <= other.high:
                open_ &= ~there
        seen |= open_
    return replace(grid, cells=np.where(seen & (grid.cells != FREE), np.int8(OCCUPIED), grid.cells))


def lid(obstacle: Obstacle, eye: float) -> float | None:
    """Return the height of the underside or top visible to a camera at the height `eye`; None at the obstacle's own
    height.
    """
    if obstacle.low > eye:
        return obstacle.low
    return obstacle.high if obstacle.high < eye else None


class LevelView:
    """Depth images of one floor by one camera. height: of the camera above the floor in metres, below the ceiling."""

    def __init__(self, plan: FloorPlan, camera: PinholeCamera, height: float):
        self._plan, self._height = plan, height
        across, down = camera.ray_slopes()
        self._across, self._down = across.astype(float), down.astype(np.float32)
        with np.errstate(divide="ignore"):
            level = np.where(self._down > 0, height, height - CEILING) / self._down  # floor or ceiling
        self._level = np.abs(level).astype(np.float32)

    def depth(self, pose_world_camera: ArrayLike) -> NDArray[np.float32]:
        """Return the depth (height, width) in metres; pose: (3,) x, y and the direction of the optical axis on the
        plan."""
        x, y, yaw = np.asarray(pose_world_camera, float)
        ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        directions = ahead - self._across[:, None] * left  # columns go to the right
        walls = cast_along(self._plan.walls, (x, y), directions).astype(np.float32)
        image = np.minimum(self._level[:, None], walls)
        seen = se2.inverse((x, y, yaw))
        for obstacle in self._plan.obstacles:
            columns = self._columns(se2.transform(seen, obstacle.corners))
            if len(columns):
                self._draw(image, obstacle, columns, (x, y), directions, walls)
        return image

    def _columns(self, corners: NDArray[np.float64]) -> range:
        """Return the columns that may show a body whose corners (K, 2) are given as ahead and left."""
        ahead, left = corners.T
        if ahead.max() <= 0:
            return range(0)
        if ahead.min() <= 1e-3:  # next to the camera: slopes change sign
            return range(len(self._across))
        slopes = -left / ahead
        first, last = np.searchsorted(self._across, [slopes.min(), slopes.max()])
        return range(int(first), int(last))

    def _draw(
        self,
        image: NDArray[np.float32],
        obstacle: Obstacle,
        columns: range,
        origin: tuple[float, float],
        directions: NDArray[np.float64],
        walls: NDArray[np.float32],
    ) -> None:
        """Draw one body if it is nearer than the current image."""
        part = slice(columns.start, columns.stop)
        enter, leave = _through(obstacle.corners, np.asarray(origin), directions[part])
        met = np.flatnonzero((enter < leave) & (enter > 0) & (enter < walls[part]))
        if not len(met):
            return
        start, end = columns.start + int(met[0]), columns.start + int(met[-1]) + 1
        enter, leave = (
            np.where(enter < leave, one, np.inf)[met[0] : met[-1] + 1].astype(np.float32) for one in (enter, leave)
        )
        self._side(image[:, start:end], obstacle, enter)
        self._lid(image[:, start:end], obstacle, enter, leave)

    def _side(self, image: NDArray[np.float32], obstacle: Obstacle, enter: NDArray[np.float32]) -> None:
        near, far = enter.min(), enter[np.isfinite(enter)].max()
        slopes = [(self._height - z) / s for z in (obstacle.low, obstacle.high) for s in (near, far)]
        rows = self._rows(slopes)
        z = np.float32(self._height) - self._down[rows, None] * np.where(np.isfinite(enter), enter, 0)
        there = (z >= obstacle.low) & (z <= obstacle.high) & np.isfinite(enter)
        np.minimum(image[rows], np.where(there, enter, NONE), out=image[rows])

    def _lid(
        self, image: NDArray[np.float32], obstacle: Obstacle, enter: NDArray[np.float32], leave: NDArray[np.float32]
    ) -> None:
        """Draw the top of a body that is lower than the camera, or the bottom of one that is higher."""
        if obstacle.low <= self._height <= obstacle.high:
            return
        drop = self._height - (obstacle.high if obstacle.high < self._height else obstacle.low)
        rows = self._rows([drop / float(enter.min()), drop / float(leave[np.isfinite(leave)].max())])
        flat = np.float32(drop) / self._down[rows, None]
        there = (flat >= enter) & (flat <= leave) & np.isfinite(enter)
        np.minimum(image[rows], np.where(there, flat, NONE), out=image[rows])

    def _rows(self, slopes: list[float]) -> slice:
        """Return the rows with slopes between the smallest and the largest of these."""
        return slice(*np.searchsorted(self._down, [min(slopes) - 1e-6, max(slopes) + 1e-6]).tolist())


def _inside(obstacle: Obstacle, grid: OccupancyGrid) -> NDArray[np.bool_]:
    """Return the cells whose centres are inside an obstacle's outline, (rows, columns)."""
    rows, columns = grid.cells.shape
    x = grid.origin[0] + (np.arange(columns) + 0.5) * grid.resolution
    y = grid.origin[1] + (np.arange(rows)[:, None] + 0.5) * grid.resolution
    inside = np.ones(grid.cells.shape, bool)
    for x0, y0, x1, y1 in obstacle.outline:  # the body is on the left of each side
        inside &= (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) >= 0
    return inside


def _through(
    corners: NDArray[np.float64], origin: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the distances, in units of directions (N, 2), at which rays enter and leave a convex outline (K, 2).

    A ray that misses it leaves before it enters.
    """
    along = np.roll(corners, -1, axis=0) - corners
    inward = np.column_stack([-along[:, 1], along[:, 0]])
    distance = np.einsum("kj,kj->k", inward, corners - origin)  # inside where inward . (t direction) >= distance
    speed = directions @ inward.T
    with np.errstate(divide="ignore", invalid="ignore"):
        t = distance / speed
    enter = np.where(speed > 0, t, -np.inf).max(axis=1)
    leave = np.where(speed < 0, t, np.inf).min(axis=1)
    never = ((speed == 0) & (distance > 0)).any(axis=1)
    return np.where(never, np.inf, enter), np.where(never, -np.inf, leave)
