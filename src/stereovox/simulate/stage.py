# SPDX-License-Identifier: Apache-2.0
"""The stage of a simulation: a scene, the camera and its path, and the planes for evaluating a map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError
from stereovox.geometry.se3 import Transform, transform_points
from stereovox.simulate.d435 import D435
from stereovox.simulate.scene import Point, Scene, Solid

SHIFT = np.array([0.0137, 0.0219, -0.0123])
"""Offset of plans in metres, so that no wall is exactly on a cell's face for any round cell size."""


@dataclass(frozen=True, eq=False)
class Face:
    """A flat rectangle that the camera can see from one side: one wall of a room, the front of a box.

    corners: (4, 3) float64 in metres, world frame, counter-clockwise seen from the free side.
    """

    name: str
    corners: NDArray[np.float64]

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit vector (3,) that points to the free side."""
        a, b, _, d = self.corners
        normal = np.cross(b - a, d - a)
        return normal / np.linalg.norm(normal)


def rectangle(name: str, low: Point, high: Point, towards: Point) -> Face:
    """Return the axis-parallel face between two corners, whose free side is in the direction of the axis `towards`."""
    normal = np.array(towards, float)
    first, second = (axis for axis in range(3) if not normal[axis])
    corners = np.array([low] * 4, float)
    corners[[1, 2], first] = high[first]
    corners[[2, 3], second] = high[second]
    face = Face(name, corners)
    return face if face.normal @ normal > 0 else Face(name, corners[::-1].copy())


@dataclass(frozen=True, eq=False)
class Stage:
    """A scene and a camera that moves through it. World: z up, metres.

    build: makes the scene; called once, when needed. path: T_world_camera (4, 4) at a share of the path, 0
    (start) to 1 (end). frames, hz: number of images on the path, and images a second. faces: flat surfaces of the scene
    for evaluating a map.
    """

    build: Callable[[], Scene]
    path: Callable[[float], Transform]
    frames: int
    hz: float = 30.0
    device: D435 = D435()  # noqa: RUF009 - frozen
    faces: tuple[Face, ...] = ()

    @cached_property
    def scene(self) -> Scene:
        """The camera's surroundings."""
        return self.build()

    def moved(self, T_new_world: Transform) -> Stage:
        """Return the same stage in another frame."""
        faces = tuple(Face(face.name, transform_points(T_new_world, face.corners)) for face in self.faces)
        return replace(
            self,
            build=lambda: moved(self.scene, T_new_world),
            path=lambda share: T_new_world @ self.path(share),
            faces=faces,
        )


def moved(scene: Scene, T_new_world: Transform) -> Scene:
    """Return the same scene in another frame."""

    def carry(solid: Solid) -> Solid:
        triangles = transform_points(T_new_world, solid.triangles.reshape(-1, 3)).reshape(-1, 3, 3)
        return Solid(solid.part, solid.name, triangles)

    return Scene([carry(solid) for solid in scene.solids])


def within(name: str, value: float, low: float, high: float) -> None:
    """Raise SourceError if a parameter leaves its limits."""
    if not low <= value <= high:
        raise SourceError(f"{name}={value:g} must be between {low:g} and {high:g}")


def one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    """Raise SourceError if a parameter is not one of the known words."""
    if value not in known:
        raise SourceError(f"{name}={value} is unknown; use {' or '.join(known)}")
