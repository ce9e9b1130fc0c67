# SPDX-License-Identifier: Apache-2.0
"""Simulated scenes: closed convex solids made of triangles, and rays cast at them. World: x forward, y left, z up.

A tree of boxes round triangles, and the first triangle that rays meet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.simulate import _rays

LEAF = 4
"""Most triangles of a leaf."""
MAX_LEVELS = 64
"""Most boxes that wait while rays descend one side of the tree: one per level."""


class TriangleTree:
    """Triangles (M, 3, 3) float64 in metres, at least one and all finite, sorted into a balanced tree.

    On each level a box's triangles are split into two halves of equal number along the axis that minimises the
    halves' surfaces (Goldsmith and Salmon 1987), since rays meet a box in proportion to its surface.
    """

    def __init__(self, triangles: NDArray[np.float64]):
        levels = max(int(np.ceil(np.log2(len(triangles) / LEAF))), 0)
        low, high = triangles.min(1), triangles.max(1)
        self._order = _sorted(low, high, levels)
        self._triangles = np.ascontiguousarray(triangles[self._order], np.float64)
        self._starts = _bounds(len(triangles), levels).astype(np.int32)
        self._boxes = _boxes(low[self._order], high[self._order], self._starts)

    def nearest(
        self, origin: NDArray[np.float64], directions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Return the distance from `origin` (3,) to the first triangle in units of `directions` (N, 3), and its number.

        float32, inf if there is none; int32, -1 if there is none. A triangle without area is never met, and a
        ray on the side of two always meets one of them. Releases the GIL.
        """
        share, number = np.empty(len(directions), np.float32), np.empty(len(directions), np.int32)
        sides, planes = np.empty((len(self._order), 9)), np.empty((len(self._order), 4))
        _rays.look(self._triangles, origin, sides, planes)
        _rays.nearest(
            np.ascontiguousarray(directions, np.float32),
            (self._boxes - np.tile(origin, 2)).astype(np.float32),
            self._starts,
            sides,
            planes,
            np.empty((7, _rays.LANES), np.float32),
            np.empty(_rays.LANES, np.int32),
            np.empty(MAX_LEVELS, np.int32),
            share,
            number,
        )
        return share, np.where(number < 0, np.int32(-1), self._order[number])


def _bounds(count: int, level: int) -> NDArray[np.int64]:
    """Return the starts of the 2 ** level parts of `count` sorted triangles, and the end."""
    return count * np.arange(2**level + 1) >> level


def _sorted(low: NDArray[np.float64], high: NDArray[np.float64], levels: int) -> NDArray[np.int32]:
    """Return the order (M,) that keeps the triangles of each box together, on all levels."""
    middle = low + high
    order = np.arange(len(low), dtype=np.int32)
    for level in range(levels):
        box = np.repeat(np.arange(2**level), np.diff(_bounds(len(order), level)))
        halves = _bounds(len(order), level + 1)[:-1]
        along = [order[np.lexsort((middle[order, axis], box))] for axis in range(3)]
        cost = [
            _surface(np.minimum.reduceat(low[way], halves), np.maximum.reduceat(high[way], halves)) for way in along
        ]
        best = np.reshape(cost, (3, -1, 2)).sum(2).argmin(0)
        order = np.choose(best[box], along)
    return order


def _surface(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return half the surface of boxes (N, 3)."""
    x, y, z = (high - low).T
    return x * y + y * z + z * x


def _boxes(low: NDArray[np.float64], high: NDArray[np.float64], starts: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the lowest and highest corner (nodes, 6) of all nodes: 0 is unused, 1 all, 2 and 3 its halves, and so
    on."""
    levels = [(np.minimum.reduceat(low, starts[:-1]), np.maximum.reduceat(high, starts[:-1]))]
    while len(levels[0][0]) > 1:
        low, high = levels[0]
        levels.insert(0, (np.minimum(low[::2], low[1::2]), np.maximum(high[::2], high[1::2])))
    return np.concatenate([np.zeros((1, 6)), *map(np.hstack, levels)])


Point = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed convex body.

    part: the group it belongs to (`poles`, `table`, ...), name: its own unique name.
    triangles: (N, 3, 3) float64 corners in metres, world frame, counter-clockwise seen from outside.
    """

    part: str
    name: str
    triangles: NDArray[np.float64]

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner (2, 3) in metres."""
        corners = self.triangles.reshape(-1, 3)
        return np.stack([corners.min(0), corners.max(0)])

    @cached_property
    def planes(self) -> NDArray[np.float64]:
        """Outward unit normals and offsets (M, 4): a point x is in the solid if `n . x <= d` for all planes."""
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        normals = np.cross(b - a, c - a)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        planes = np.column_stack([normals, np.einsum("ij,ij->i", normals, a)])
        return np.unique(planes.round(9), axis=0)

    def contains(self, points: ArrayLike, margin: float = 1e-6) -> NDArray[np.bool_]:
        """Return which points (N, 3) are in the solid; points up to `margin` metres outside count as inside."""
        points = np.asarray(points, float)
        left = np.arange(len(points))
        for *normal, offset in self.planes:  # most points are soon found to be outside
            left = left[points[left] @ normal <= offset + margin]
        inside = np.zeros(len(points), bool)
        inside[left] = True
        return inside


class Scene:
    """Solids, and the first surface that rays meet."""

    def __init__(self, solids: Sequence[Solid]):
        self.solids = tuple(solids)
        self.triangles = np.concatenate([solid.triangles for solid in self.solids])

    def parts(self) -> list[str]:
        """Return the names of all parts in the order they were built."""
        return list(dict.fromkeys(solid.part for solid in self.solids))

    def part(self, name: str) -> list[Solid]:
        """Return the solids of one part."""
        return [solid for solid in self.solids if solid.part == name]

    def cast(self, origin: ArrayLike, directions: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return the distance from `origin` (3,) to the first surface in units of `directions` (N, 3), inf without any.

        For directions whose component along the optical axis is 1 this is the depth. float32, releases the GIL.
        """
        return self._tree.nearest(np.array(origin, np.float64), np.asarray(directions, np.float32))[0]

    def hits(
        self, origin: ArrayLike, directions: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
        """Return the result of `cast`, the unit normals (N, 3) of the surfaces, and their triangles (N,), -1: none.

        Normals are outward, 0 if there is none.
        """
        share, met = self._tree.nearest(np.array(origin, np.float64), np.asarray(directions, np.float32))
        return share, np.where(met[:, None] < 0, np.float32(0), self._normals[met]), met

    @cached_property
    def _tree(self) -> TriangleTree:
        return TriangleTree(self.triangles)

    @cached_property
    def _normals(self) -> NDArray[np.float32]:
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        normals = np.cross(b - a, c - a)
        return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)).astype(np.float32)


def box(
    part: str, name: str, low: Point, high: Point, turn: float = 0.0, about: tuple[float, float] | None = None
) -> Solid:
    """Return a box between two corners, turned by `turn` radians round the vertical through `about` (its centre)."""
    import trimesh

    low_, high_ = np.asarray(low, float), np.asarray(high, float)
    mesh = trimesh.creation.box(extents=high_ - low_)
    mesh.apply_translation((low_ + high_) / 2)
    return _turned(Solid(part, name, np.array(mesh.triangles)), turn, about)


def cylinder(part: str, name: str, start: Point, end: Point, diameter: float, sections: int = 20) -> Solid:
    """Return a round bar between two points."""
    import trimesh

    mesh = trimesh.creation.cylinder(radius=diameter / 2, segment=np.array([start, end], float), sections=sections)
    return Solid(part, name, np.array(mesh.triangles))


def _turned(solid: Solid, turn: float, about: tuple[float, float] | None) -> Solid:
    if not turn:
        return solid
    middle = np.append(about if about is not None else solid.bounds.mean(0)[:2], 0.0)
    cosine, sine = np.cos(turn), np.sin(turn)
    rotation = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    return Solid(solid.part, solid.name, (solid.triangles - middle) @ rotation.T + middle)
