# SPDX-License-Identifier: Apache-2.0
"""Map prepared for drawing: turned upright, with the layers at which to cut it.

Viewpoint of a picture: the camera stored in the map, or one given by the user.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import StereovoxError, did_you_mean
from stereovox.frame import Viewpoint
from stereovox.geometry.se3 import look_at
from stereovox.maps import State, VoxelMap
from stereovox.maps.upright import SLAB, ceiling, layers, turned_cells, usual_layers
from stereovox.maps.upright import UPS as UPS
from stereovox.maps.upright import turned as turned
from stereovox.view.render import Occlusion

BESIDE = 0.1
"""A camera's path is drawn up to this share of the map's longest side beyond its known cells."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A map whose third axis points up.

    cells: (N, 3) int32 known cells; state: (N,) uint8 of `State`; path: camera positions (M, 3) in metres, NaN if
    the line breaks, or None; names: the map's own names of the three axes.
    """

    cells: NDArray[np.int32]
    state: NDArray[np.uint8]
    voxel_size: float
    path: NDArray[np.float64] | None
    names: tuple[str, str, str]

    @cached_property
    def occupied(self) -> NDArray[np.int32]:
        """Occupied cells (K, 3)."""
        return self.cells[self.state == State.OCCUPIED]

    @cached_property
    def below_ceiling(self) -> NDArray[np.int32]:
        """Occupied cells without a ceiling."""
        return self.occupied[self.occupied[:, 2] < ceiling(self.occupied)]

    @cached_property
    def occlusion(self) -> Occlusion:
        """Occlusion of the faces of the cells `below_ceiling`."""
        return Occlusion(self.below_ceiling)

    @cached_property
    def cut(self) -> float | None:
        """Height in metres above which cells are hidden, None if all are drawn."""
        if len(self.below_ceiling) == len(self.occupied):
            return None
        return ceiling(self.occupied) * self.voxel_size

    @cached_property
    def layer(self) -> int:
        """The most informative layer: no floor or ceiling, many known cells, and then the most occupied cells."""
        low, known = layers(self.cells)
        occupied = np.bincount(self.occupied[:, 2] - low, minlength=len(known))
        first, end = usual_layers(occupied)
        usual = np.median(part) if (part := occupied[first:end][occupied[first:end] > 0]).size else np.inf
        known = np.where(occupied > SLAB * usual, 0, known)
        return int(low + np.argmax(np.where(known >= 0.9 * known.max(), occupied + 1, 0)))


def camera_path(voxel_map: VoxelMap) -> NDArray[np.float64]:
    """Return the path (N, 3) in metres of a map's cameras for drawing: NaN at breaks.

    It breaks between two cameras, and outside the map: a map may cover only a part of its cameras' view.
    """
    lines, bounds = voxel_map.history.path.lines(), voxel_map.bounds()
    if not lines or bounds is None:
        return np.empty((0, 3))
    gap = np.full((1, 3), np.nan)
    path = np.concatenate([part for line in lines for part in (line, gap)][:-1])
    low, high = bounds
    margin = BESIDE * float((high - low).max())
    inside = ((path >= low - margin) & (path <= high + margin)).all(axis=1)
    return np.where(inside[:, None], path, np.nan) if inside.any() else np.empty((0, 3))


def checked_up(up: str) -> str:
    """Return a key of `UPS` (`+z` is `z`). Raises StereovoxError for an invalid axis."""
    if up.removeprefix("+") not in UPS:
        raise StereovoxError(f"up '{up}' is no axis of the map{did_you_mean(up, UPS)}")
    return up.removeprefix("+")


def upright(voxel_map: VoxelMap, trajectory: ArrayLike | None, up: str) -> Drawn:
    """Turn a map so that its axis `up` (`z`, `-y`, ...) becomes the third, and a path (M, 3) with it.

    Raises StereovoxError for an invalid axis.
    """
    up = checked_up(up)
    cells, _ = voxel_map.cells()
    state = voxel_map.state(voxel_map.centers(cells))
    path = None if trajectory is None else turned(np.reshape(np.asarray(trajectory, float), (-1, 3)), up)
    return stood_up(cells, state, voxel_map.voxel_size, up, path)


def stood_up(
    cells: NDArray[np.int32],
    state: NDArray[np.uint8],
    voxel_size: float,
    up: str,
    path: NDArray[np.float64] | None = None,
) -> Drawn:
    """Return cells (N, 3) of a map whose axis `up`, a key of `UPS`, becomes the third. path: turned already."""
    order = list(UPS[up])
    return Drawn(turned_cells(cells, up), state, voxel_size, path, ("xyz"[order[0]], "xyz"[order[1]], up))


FIELD_M = 1.0
"""Depth of a drawn field of view (Chien 2020, Fig 4.7)."""
USUAL = PinholeCamera.from_field_of_view(848, 480, 91.2, 0.05)
"""A D435 (Chien 2020, 2.2.1), for maps without a camera."""


def known_viewpoint(viewpoint: Viewpoint | None) -> Viewpoint:
    """Return `viewpoint`; raises StereovoxError if missing."""
    if viewpoint is None:
        raise StereovoxError("the map has no camera pose; give one: --eye=X,Y,Z --toward=X,Y,Z")
    return viewpoint


def viewpoint_at(
    voxel_map: VoxelMap, eye: Sequence[float] | None, toward: Sequence[float] | None, up: str
) -> Viewpoint | None:
    """Return a viewpoint at `eye` that looks `toward` a point, both in metres, world frame; else the map's own.

    The camera is the map's last one, or a D435's. Raises StereovoxError if only one of the two is given, or they
    name the same point.
    """
    if eye is None and toward is None:
        return voxel_map.viewpoint
    if eye is None or toward is None:
        raise StereovoxError("a camera needs both: --eye=X,Y,Z --toward=X,Y,Z")
    gaze = np.subtract(toward, eye)
    if not np.linalg.norm(gaze) > 0:
        raise StereovoxError(f"--eye and --toward are the same point {tuple(eye)}; name two")
    camera = USUAL if voxel_map.viewpoint is None else voxel_map.viewpoint.camera
    upwards = np.zeros(3)
    upwards["xyz".index(up[-1])] = -1 if up.startswith("-") else 1
    if np.linalg.norm(np.cross(upwards, gaze)) < 1e-6 * np.linalg.norm(gaze):
        upwards = np.roll(upwards, 1)  # straight up or down: any side may be above
    return Viewpoint(camera, look_at(eye, toward, upwards))


def field_of_view(viewpoint: Viewpoint, depth_m: float = FIELD_M) -> NDArray[np.float64]:
    """Return the edges (8, 2, 3) in metres, world frame, of the pyramid that the camera sees up to `depth_m`.

    First the four from the camera to the corners, then the four around the far side.
    """
    camera, T = viewpoint.camera, viewpoint.T_world_camera
    u, v = np.array([-0.5, camera.width - 0.5]), np.array([-0.5, camera.height - 0.5])
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    corners = np.array([[x[0], y[0], 1], [x[1], y[0], 1], [x[1], y[1], 1], [x[0], y[1], 1]]) * depth_m
    world = corners @ T[:3, :3].T + T[:3, 3]
    spokes = np.stack([np.broadcast_to(T[:3, 3], (4, 3)), world], axis=1)
    return np.concatenate([spokes, np.stack([world, np.roll(world, -1, axis=0)], axis=1)])
