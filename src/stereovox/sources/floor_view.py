# SPDX-License-Identifier: Apache-2.0
"""Exact depth images of a floor for a camera that is level: all pixels of a column look the same way on the plan.

So each column needs one ray on the plan, and each thing the two places where that ray enters and leaves its outline.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import planar
from stereovox.cameras import PinholeCamera
from stereovox.sources.floor_plan import CEILING, FloorPlan, Thing
from stereovox.sources.floor_rays import cast_along

NONE = np.float32(np.inf)


class LevelView:
    """Depth images of one floor by one camera. height: of the camera over the floor in metres, below the ceiling."""

    def __init__(self, plan: FloorPlan, camera: PinholeCamera, height: float):
        self._plan, self._height = plan, height
        across, down = camera.ray_slopes()
        self._across, self._down = across.astype(float), down.astype(np.float32)
        with np.errstate(divide="ignore"):
            level = np.where(self._down > 0, height, height - CEILING) / self._down  # floor or ceiling
        self._level = np.abs(level).astype(np.float32)

    def depth(self, pose_world_camera: ArrayLike) -> NDArray[np.float32]:
        """Return the depth (height, width) in metres; pose: (3,) x, y and where the optical axis points on the plan."""
        x, y, yaw = np.asarray(pose_world_camera, float)
        ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
        directions = ahead - self._across[:, None] * left  # columns go to the right
        walls = cast_along(self._plan.walls, (x, y), directions).astype(np.float32)
        image = np.minimum(self._level[:, None], walls)
        seen = planar.inverse((x, y, yaw))
        for thing in self._plan.things:
            columns = self._columns(planar.transform(seen, thing.corners))
            if len(columns):
                self._draw(image, thing, columns, (x, y), directions, walls)
        return image

    def _columns(self, corners: NDArray[np.float64]) -> range:
        """Return the columns that a body may be in, whose corners (K, 2) are given as ahead and left."""
        ahead, left = corners.T
        if ahead.max() <= 0:
            return range(0)
        if ahead.min() <= 1e-3:  # beside the camera: its slopes turn over
            return range(len(self._across))
        slopes = -left / ahead
        first, last = np.searchsorted(self._across, [slopes.min(), slopes.max()])
        return range(int(first), int(last))

    def _draw(
        self,
        image: NDArray[np.float32],
        thing: Thing,
        columns: range,
        origin: tuple[float, float],
        directions: NDArray[np.float64],
        walls: NDArray[np.float32],
    ) -> None:
        """Draw one body where it is nearer than what is there."""
        part = slice(columns.start, columns.stop)
        enter, leave = _through(thing.corners, np.asarray(origin), directions[part])
        met = np.flatnonzero((enter < leave) & (enter > 0) & (enter < walls[part]))
        if not len(met):
            return
        start, end = columns.start + int(met[0]), columns.start + int(met[-1]) + 1
        enter, leave = (
            np.where(enter < leave, one, np.inf)[met[0] : met[-1] + 1].astype(np.float32) for one in (enter, leave)
        )
        self._side(image[:, start:end], thing, enter)
        self._lid(image[:, start:end], thing, enter, leave)

    def _side(self, image: NDArray[np.float32], thing: Thing, enter: NDArray[np.float32]) -> None:
        near, far = enter.min(), enter[np.isfinite(enter)].max()
        slopes = [(self._height - z) / s for z in (thing.low, thing.high) for s in (near, far)]
        rows = self._rows(slopes)
        z = np.float32(self._height) - self._down[rows, None] * np.where(np.isfinite(enter), enter, 0)
        there = (z >= thing.low) & (z <= thing.high) & np.isfinite(enter)
        np.minimum(image[rows], np.where(there, enter, NONE), out=image[rows])

    def _lid(
        self, image: NDArray[np.float32], thing: Thing, enter: NDArray[np.float32], leave: NDArray[np.float32]
    ) -> None:
        """Draw the top of a body that is lower than the camera, or the bottom of one that is higher."""
        if thing.low <= self._height <= thing.high:
            return
        drop = self._height - (thing.high if thing.high < self._height else thing.low)
        rows = self._rows([drop / float(enter.min()), drop / float(leave[np.isfinite(leave)].max())])
        flat = np.float32(drop) / self._down[rows, None]
        there = (flat >= enter) & (flat <= leave) & np.isfinite(enter)
        np.minimum(image[rows], np.where(there, flat, NONE), out=image[rows])

    def _rows(self, slopes: list[float]) -> slice:
        """Return the rows that look down at slopes between the least and the largest of these."""
        return slice(*np.searchsorted(self._down, [min(slopes) - 1e-6, max(slopes) + 1e-6]).tolist())


def _through(
    corners: NDArray[np.float64], origin: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how often directions (N, 2) fit before they enter, and leave, a convex outline (K, 2).

    A ray that never does leaves before it enters.
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
