# SPDX-License-Identifier: Apache-2.0
"""The input of a local planner: obstacles around the robot and the extent of free space, for Nav2's costmaps.

A costmap keeps a marked cell until a ray of a clearing source passes over it; nothing else removes it. So there are two
clouds with one stamp: `obstacles` to mark, and `free_rays`, the last free cells in all directions, to clear up to. Both
come from the map, which has weighed all evidence.

The error of the 2-D map against a reference while it is made (IST 2019, Eq 7), in a thread of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.grid_align import Rectangle
from stereovox.evaluate.grid_scores import CellErrors, cell_errors, differences, laid_on
from stereovox.formats.map_server import read_map_server
from stereovox.geometry import se2
from stereovox.geometry.se3 import Transform
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.maps.voxel_map import State
from stereovox.ros.library import Background
from stereovox.ros.mapping import Mapping
from stereovox.ros.options import Options, region_of
from stereovox.ros.outputs import points_message

OBSTACLES, FREE_RAYS = "obstacles", "free_rays"
"""Topics."""
STEP = 0.5
"""Cells between samples on a ray."""


def obstacle_points(grid: OccupancyGrid, place: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """Return the centres (N, 2) of occupied cells within `reach` metres of a place (2,), in the map's frame."""
    rows, columns = np.nonzero(grid.states == State.OCCUPIED)
    points = grid.centres(rows, columns)
    return points[np.linalg.norm(points - place, axis=1) <= reach]


def free_ends(grid: OccupancyGrid, place: NDArray[np.float64], reach: float, blind: float) -> NDArray[np.float64]:
    """Return the centres (N, 2) of the last free cells around a place (2,), one in each direction that has any.

    A ray ends before the first cell that is not free. Unknown cells up to `blind` metres do not end it, since a camera
    does not see the floor at its feet; others do: they may be anything. Rays are one cell apart at `reach` metres.
    """
    fan, distances = _fan(round(reach / grid.resolution))
    at = se2.transform(se2.inverse(grid.origin), place[None])[0] / grid.resolution  # in cells: column, row
    corner, states = _window(grid, at, len(distances))
    columns, rows = ((at[axis] - corner[axis] + fan[axis]).astype(np.int32) for axis in (0, 1))
    found = states.ravel()[rows * np.int32(states.shape[1]) + columns]
    free = found == State.FREE
    passes = free | ((found == State.UNKNOWN) & (distances <= blind / grid.resolution))
    open_to = np.logical_and.accumulate(passes, axis=1) & free
    rays = np.flatnonzero(open_to.any(axis=1))
    last = open_to.shape[1] - 1 - np.argmax(open_to[rays, ::-1], axis=1)
    return grid.centres(rows[rays, last] + corner[1], columns[rays, last] + corner[0])


@lru_cache(maxsize=4)
def _fan(reach: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return samples on rays in all directions, (2, rays, steps) x and y in cells, and their distances (steps,)."""
    distances = np.arange(STEP, reach, STEP, dtype=np.float32)
    angles = np.arange(0.0, 2 * np.pi, 1 / reach)
    directions = np.stack([np.cos(angles), np.sin(angles)]).astype(np.float32)
    return directions[:, :, None] * distances, distances


def _window(grid: OccupancyGrid, at: NDArray[np.float64], steps: int) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return column and row of the first cell that rays may reach, and the states of all such cells, unknown outside
    the grid."""
    half = int(np.ceil(steps * STEP)) + 2
    corner, (rows, columns) = np.floor(at).astype(np.int64) - half, grid.cells.shape
    cells = np.full((2 * half + 1, 2 * half + 1), UNKNOWN, np.int8)
    (left, bottom), (right, top) = np.maximum(corner, 0), np.minimum(corner + 2 * half + 1, (columns, rows))
    if left < right and bottom < top:
        x, y = corner
        cells[bottom - y : top - y, left - x : right - x] = grid.cells[bottom:top, left:right]
    return corner, replace(grid, cells=cells).states


class Obstacles:
    """Publishes both clouds while trusted frames arrive, with the stamp of the newest one.

    Without such frames nothing is published, so that stamps show whether the map is current. Nor is anything published
    while any sensor's newest frame is older than `trust.stale_s`, since its view may no longer be free. clock:
    monotonic seconds.
    """

    def __init__(self, node: Any, mapping: Mapping, options: Options, clock: Callable[[], float] = monotonic):
        from sensor_msgs.msg import PointCloud2

        self._node, self._mapping, self._options, self._clock = node, mapping, options, clock
        self._publishers = [node.create_publisher(PointCloud2, topic, 1) for topic in (OBSTACLES, FREE_RAYS)]
        self._newest: tuple[int, str, NDArray[np.float64]] | None = None
        self._next = 0.0
        self._height = sum(options.heights or mapping.config.scan.heights) / 2

    def seen(self, stamp_ns: int, world: str, T_world_base: Transform) -> None:
        """Record that a frame was mapped, and the robot's pose."""
        self._newest = stamp_ns, world, T_world_base[:2, 3]

    def update(self) -> None:
        """Publish what is due."""
        now = self._clock()
        if self._newest is None or now < self._next:
            return
        if not any(one.get_subscription_count() for one in self._publishers):
            return
        if silent := self._stale():
            self._node.get_logger().error(f"no obstacles: {silent}", throttle_duration_sec=10.0)
            return
        self._next = now + 1 / self._options.obstacle_rate
        (stamp_ns, world, place), self._newest = self._newest, None
        try:
            grid = self._mapping.grid()
        except StereovoxError as error:
            self._node.get_logger().error(f"no obstacles: {error}", throttle_duration_sec=10.0)
            return
        if grid is None:
            return
        reach = self._options.obstacle_range
        clouds = obstacle_points(grid, place, reach), free_ends(grid, place, reach, self._options.blind_m)
        for publisher, points in zip(self._publishers, clouds, strict=True):
            lifted = np.column_stack([points, np.full(len(points), self._height)])
            publisher.publish(points_message(lifted, stamp_ns, world))

    def _stale(self) -> str:
        """Return a line about a sensor whose newest trusted frame is too old, or unconfirmed; "" for none."""
        health, most_s = self._mapping.health(), self._mapping.config.trust.stale_s
        if health.state == "waiting":
            return health.text
        ages_s = health.ages_s
        sensor, age_s = max(ages_s.items(), key=lambda item: item[1], default=("", 0.0))
        stale = age_s > most_s
        return f"the last trusted frame of {sensor} is {age_s:.2f} s old (trust.stale_s {most_s:g})" if stale else ""


TOPIC = "map_error"
PERIOD_S = 1.0
"""Least seconds between two scores."""


def error_of(grid: OccupancyGrid, reference: OccupancyGrid, exclude: Sequence[Rectangle]) -> CellErrors:
    """Return the differences of a map from a reference in the same frame; raises StereovoxError as `score_grids`."""
    laid = laid_on(grid, reference, exclude, align=False)
    return cell_errors(laid, differences(laid))


def score_of(node: Any, mapping: Mapping, options: Options) -> Score | None:
    """Return the comparison of the map with the options' reference, None without one; raises StereovoxError."""
    file = options.reference or options.floor
    if not file:
        return None
    reference = read_map_server(file)
    if reference.note:
        node.get_logger().warning(f"{file}: {reference.note}")
    return Score(node, mapping, reference, [region_of(text) for text in options.exclude])


class Score:
    """Publishes Eq 7 in per cent on `map_error` (std_msgs/Float32) while the map changes.

    exclude: regions (x0, y0, x1, y1) in metres that do not count. clock: monotonic seconds.
    """

    def __init__(self, node: Any, mapping: Mapping, reference: OccupancyGrid, exclude: Sequence[Rectangle] = (),
                 clock: Callable[[], float] = monotonic):  # fmt: skip
        from std_msgs.msg import Float32

        self._node, self._mapping, self._reference, self._exclude = node, mapping, reference, exclude
        self._clock, self._message = clock, Float32
        self._publisher = node.create_publisher(Float32, TOPIC, 10)
        self._work: Background[CellErrors] = Background("stereovox-score")
        self._next, self._frames, self._busy = 0.0, 0, False
        self._last: CellErrors | None = None

    def counts(self) -> dict[str, object]:
        """Return the values for diagnostics."""
        return {} if self._last is None else self._values(self._last)

    def update(self) -> None:
        """Publish a finished score, and begin the next one if it is due."""
        if (ended := self._work.poll()) is not None:
            self._busy = False
            self._take(ended.result)
        now, frames = self._clock(), self._mapping.history.frames
        if self._busy or now < self._next or frames == self._frames:
            return
        if (grid := self._grid()) is not None:
            self._next, self._frames, self._busy = now + PERIOD_S, frames, True
            self._work.put(partial(error_of, grid, self._reference, self._exclude))

    def final(self) -> dict[str, object]:
        """Score the present map, and return Eq 7 and its parts in per cent; empty without a map."""
        self._work.drop()
        self._busy = False
        if (grid := self._grid(last=True)) is not None:
            self._take(lambda: error_of(grid, self._reference, self._exclude))
        return self.counts()

    def _grid(self, last: bool = False) -> OccupancyGrid | None:
        try:
            return self._mapping.grid(last)  # a copy, since the map may change
        except StereovoxError as error:
            self._node.get_logger().warning(f"no score: {error}", throttle_duration_sec=30.0)
            return None

    def _take(self, score: Callable[[], CellErrors]) -> None:
        try:
            self._last = last = score()
        except StereovoxError as error:
            self._node.get_logger().warning(f"no score: {error}", throttle_duration_sec=30.0)
            return
        self._publisher.publish(self._message(data=float(last.eq7_percent)))

    @staticmethod
    def _values(errors: CellErrors) -> dict[str, object]:
        return {
            "eq7_percent": errors.eq7_percent,
            "eq7_coverage_percent": errors.eq7_coverage_percent,
            "eq7_contradiction_percent": errors.eq7_contradiction_percent,
        }
