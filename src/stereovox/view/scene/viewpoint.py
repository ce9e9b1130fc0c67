# SPDX-License-Identifier: Apache-2.0
"""Viewpoint of a picture: the camera stored in the map, or one given by the user."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.geometry.se3 import look_at
from stereovox.maps import VoxelMap

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
