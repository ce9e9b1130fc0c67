# SPDX-License-Identifier: Apache-2.0
"""The plan of one floor of a building: rooms, and upright obstacles in them.

Metres; x, y on the floor, z up from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.simulate.scene import Scene, Solid

Rectangle = tuple[float, float, float, float]
"""x from, y from, x to, y to."""
CEILING = 2.6
WALL = 0.2
"""Thickness of the outer walls, floor and ceiling."""


@dataclass(frozen=True, eq=False)
class Obstacle:
    """An upright body with a flat bottom and top.

    part, name: as in `Solid`. corners: (K, 2) of its convex outline, counter-clockwise. low, high: heights.
    """

    part: str
    name: str
    corners: NDArray[np.float64]
    low: float
    high: float

    @property
    def outline(self) -> NDArray[np.float64]:
        """Its sides (K, 4): x, y from and to, with the body on the left."""
        return np.hstack([self.corners, np.roll(self.corners, -1, axis=0)])

    @property
    def solid(self) -> Solid:
        """The same as triangles."""
        return upright(self.part, self.name, self.corners, self.low, self.high)


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """Walls around the free rectangles (rooms, corridors, door openings), and the obstacles in them.

    free: rectangles whose union is free of walls; they may overlap. obstacles: everything else. A shut door is an
    obstacle in an opening.
    """

    free: Sequence[Rectangle]
    obstacles: Sequence[Obstacle] = field(default_factory=tuple)

    @cached_property
    def walls(self) -> NDArray[np.float64]:
        """The walls' surfaces (N, 4): x, y from and to, with pieces as long as possible."""
        xs, ys, free = self._compressed
        upright_sides = _runs(np.diff(free.astype(np.int8), axis=1, prepend=0, append=0) != 0)
        level_sides = _runs(np.diff(free.astype(np.int8), axis=0, prepend=0, append=0).T != 0)
        upright_ = [(xs[column], ys[a], xs[column], ys[b]) for a, b, column in upright_sides]
        return np.array(upright_ + [(xs[a], ys[row], xs[b], ys[row]) for a, b, row in level_sides], float)

    def outline(self, low: float, high: float) -> NDArray[np.float64]:
        """Return all surfaces (N, 4) that a level ray somewhere between two heights may meet."""
        standing = [obstacle.outline for obstacle in self.obstacles if obstacle.low <= high and obstacle.high >= low]
        return np.concatenate([self.walls, *standing])

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner (2, 2) of all rooms."""
        free = np.asarray(self.free, float)
        return np.stack([free[:, :2].min(0), free[:, 2:].max(0)])

    def truth(self, resolution: float, inside: ArrayLike, heights: tuple[float, float] = (0.1, 1.8)) -> OccupancyGrid:
        """Return a perfect map of the floor as seen from the point `inside` (2,).

        Occupied: cells that an upright surface between `heights` crosses and that border on free ones. Free: other
        cells that can be reached from `inside`. Unknown: cells behind the surfaces; `with_lids` adds tops and
        undersides. Cell corners are at whole multiples of `resolution`.
        """
        from scipy import ndimage

        first = np.floor(self.bounds[0] / resolution).astype(int) - 2
        size = np.ceil(self.bounds[1] / resolution).astype(int) + 2 - first
        crossed = np.zeros(size[::-1], bool)
        for points in map(np.array, _sampled(self.outline(*heights), resolution / 8)):
            columns, rows = (np.floor(points / resolution).astype(int) - first).T
            crossed[rows, columns] = True
        labels = np.asarray(ndimage.label(~crossed)[0])
        column, row = np.floor(np.asarray(inside, float) / resolution).astype(int) - first
        free = (labels == labels[row, column]) & ~crossed
        seen = crossed & ndimage.binary_dilation(free, np.ones((3, 3)))
        cells = np.where(seen, 100, np.where(free, 0, UNKNOWN)).astype(np.int8)
        return OccupancyGrid(cells, resolution, (first[0] * resolution, first[1] * resolution, 0.0))

    @cached_property
    def scene(self) -> Scene:
        """Everything as solids, with floor and ceiling."""
        xs, ys, free = self._compressed
        blocks = [
            upright("walls", f"wall {n}", _corners(xs[a], ys[row], xs[b], ys[row + 1]), 0, CEILING)
            for n, (a, b, row) in enumerate(_runs(~free.T))
        ]
        corners = _corners(xs[0], ys[0], xs[-1], ys[-1])
        floor = upright("floor", "floor", corners, -WALL, 0)
        ceiling = upright("ceiling", "ceiling", corners, CEILING, CEILING + WALL)
        return Scene([floor, ceiling, *blocks, *(obstacle.solid for obstacle in self.obstacles)])

    @cached_property
    def _compressed(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """All x and y at which a rectangle begins or ends, and whether the fields (rows, columns) between are free."""
        free = np.asarray(self.free, float)
        (x0, y0), (x1, y1) = self.bounds
        xs = np.unique([*free[:, 0], *free[:, 2], x0 - WALL, x1 + WALL])
        ys = np.unique([*free[:, 1], *free[:, 3], y0 - WALL, y1 + WALL])
        x, y = (xs[1:] + xs[:-1]) / 2, (ys[1:] + ys[:-1]) / 2
        inside = np.zeros((len(y), len(x)), bool)
        for a, b, c, d in free:
            inside |= ((y > b) & (y < d))[:, None] & ((x > a) & (x < c))
        return xs, ys, inside


def block(
    part: str,
    name: str,
    where: Rectangle,
    heights: tuple[float, float],
    turn_deg: float = 0.0,
    about: tuple[float, float] | None = None,
) -> Obstacle:
    """Return an upright box whose outline is a rectangle, turned to the left about a point (its centre)."""
    corners = _corners(*where)
    middle = corners.mean(0) if about is None else np.asarray(about, float)
    turn = np.radians(turn_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return Obstacle(part, name, (corners - middle) @ rotation.T + middle, *heights)


def post(part: str, name: str, middle: tuple[float, float], diameter: float, high: float) -> Obstacle:
    """Return a round post on the floor, with sixteen sides."""
    angles = np.arange(16) * np.pi / 8
    ring = np.column_stack([np.cos(angles), np.sin(angles)]) * diameter / 2
    return Obstacle(part, name, ring + np.asarray(middle, float), 0.0, high)


def upright(part: str, name: str, corners: NDArray[np.float64], low: float, high: float) -> Solid:
    """Return an upright solid over a convex outline (K, 2), counter-clockwise."""
    count = len(corners)
    bottom, top = (np.column_stack([corners, np.full(count, z)]) for z in (low, high))
    triangles = []
    for a in range(count):
        b = (a + 1) % count
        triangles += [(bottom[a], bottom[b], top[b]), (bottom[a], top[b], top[a])]
    for a in range(1, count - 1):
        triangles += [(top[0], top[a], top[a + 1]), (bottom[0], bottom[a + 1], bottom[a])]
    return Solid(part, name, np.array(triangles))


def _corners(x0: float, y0: float, x1: float, y1: float) -> NDArray[np.float64]:
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], float)


def _runs(marked: NDArray[np.bool_]) -> list[tuple[int, int, int]]:
    """Return the runs of marks along the first axis: from, to (exclusive) and column."""
    edges = np.diff(marked.astype(np.int8), axis=0, prepend=0, append=0).T
    columns, starts = np.nonzero(edges == 1)
    _, ends = np.nonzero(edges == -1)
    return list(zip(starts.tolist(), ends.tolist(), columns.tolist(), strict=True))


def _sampled(segments: NDArray[np.float64], step: float) -> list[NDArray[np.float64]]:
    """Return points (N, 2) on each segment, at most `step` apart."""
    found = []
    for segment in segments:
        start, end = segment[:2], segment[2:]
        count = int(np.ceil(np.linalg.norm(end - start) / step)) + 1
        found.append(start + np.linspace(0, 1, count)[:, None] * (end - start))
    return found
