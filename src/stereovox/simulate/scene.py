# SPDX-License-Identifier: Apache-2.0
"""Simulated scenes: closed convex solids made of triangles, and rays cast at them. World: x forward, y left, z up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.simulate.triangle_tree import TriangleTree

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
