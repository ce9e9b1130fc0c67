# SPDX-License-Identifier: Apache-2.0
"""Distances of points from the surfaces of a simulated scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.simulate.scene import Scene


class Clearance:
    """Distances to the triangles of a scene, exact."""

    def __init__(self, scene: Scene):
        a, b, c = np.moveaxis(scene.triangles, 1, 0)
        self._corners, self._sides = (a, b, c), (b - a, c - b, a - c)
        normal = np.cross(b - a, c - a)
        self._normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
        self._low, self._high = scene.triangles.min(axis=1), scene.triangles.max(axis=1)

    def at(self, point: NDArray[np.float64], farthest: float = np.inf) -> float:
        """Return the distance in metres from a point (3,) to the nearest surface; `farthest` if that is farther."""
        near = np.flatnonzero(np.linalg.norm(self._outside(point), axis=1) < farthest)
        if not len(near):
            return farthest
        return min(farthest, float(self._distances(point, near).min()))

    def _outside(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance of a point outside the box around each triangle (M, 3)."""
        return np.maximum(np.maximum(self._low - point, point - self._high), 0)

    def _distances(self, point: NDArray[np.float64], which: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the distances (n,): to the plane if the foot is within the triangle, else to its nearest side."""
        normal = self._normal[which]
        within = np.ones(len(which), bool)
        to_sides = np.full(len(which), np.inf)
        for corner, side in zip(self._corners, self._sides, strict=True):
            start, along = corner[which], side[which]
            off = point - start
            within &= (np.cross(along, off) * normal).sum(axis=1) >= 0
            share = np.clip((off * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-30), 0, 1)
            to_sides = np.minimum(to_sides, np.linalg.norm(off - share[:, None] * along, axis=1))
        to_plane = np.abs(((point - self._corners[0][which]) * normal).sum(axis=1))
        return np.where(within, to_plane, to_sides)
