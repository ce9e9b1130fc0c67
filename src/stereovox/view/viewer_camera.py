# SPDX-License-Identifier: Apache-2.0
"""The depth camera in the viewer: axes, field of view and optical axis; and from where the page looks at first."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.frame import Viewpoint
from stereovox.maps import VoxelMap
from stereovox.view.drawn import UPS, Drawn
from stereovox.view.panels import PATH_COLOUR
from stereovox.view.space import ABOVE_DEG, BEHIND_DEG
from stereovox.view.viewer_cells import rgb
from stereovox.view.whereabouts import field_of_view

if TYPE_CHECKING:
    from viser import FrameHandle, ViserServer

AXES_M = 0.3
FAR = 0.8
"""How far the page stands from the middle of the map, in diagonals of the map."""


def add_camera(server: ViserServer, viewpoint: Viewpoint, reach_m: float) -> FrameHandle:
    """Add the camera's axes, its field of view (Chien 2020, Fig 4.7) and its optical axis up to `reach_m` metres."""
    from viser.transforms import SO3

    T = viewpoint.T_world_camera
    axes = server.scene.add_frame(
        "/camera", axes_length=AXES_M, axes_radius=AXES_M / 30, wxyz=SO3.from_matrix(T[:3, :3]).wxyz, position=T[:3, 3]
    )
    local = field_of_view(viewpoint._replace(T_world_camera=np.eye(4)))
    red = rgb(PATH_COLOUR)
    server.scene.add_line_segments("/camera/field_of_view", local, red, thickness=3, thickness_units="screen")
    axis = np.array([[[0, 0, 0], [0, 0, reach_m]]], float)
    server.scene.add_line_segments("/camera/optical_axis", axis, red, thickness=1, thickness_units="screen")
    return axes


def first_look(voxel_map: VoxelMap, drawn: Drawn) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return from where the page looks at first, and at what: (3,) each in metres.

    It looks from behind the depth camera and above at the middle of the camera and the occupied cells, or of all
    cells if none is occupied.
    """
    centres = voxel_map.occupied() if len(drawn.occupied) else voxel_map.centers(voxel_map.cells()[0])
    if not len(centres):
        return np.array([3.0, 3.0, 3.0]), np.zeros(3)
    low, high = centres.min(axis=0), centres.max(axis=0)
    up = up_vector(drawn.names[2])
    back = -np.eye(3)[UPS[drawn.names[2]][1]]
    if voxel_map.viewpoint is not None:
        T = voxel_map.viewpoint.T_world_camera
        low, high, behind = np.minimum(low, T[:3, 3]), np.maximum(high, T[:3, 3]), -T[:3, 2]
        level = behind - (behind @ up) * up
        back = level / np.linalg.norm(level) if np.linalg.norm(level) > 0.1 else back  # it may look straight down
    aside, above = np.radians(BEHIND_DEG), np.radians(ABOVE_DEG)
    level = np.cos(aside) * back + np.sin(aside) * np.cross(up, back)
    look_at = (low + high) / 2
    distance = max(FAR * float(np.linalg.norm(high - low)), 1.0)
    return look_at + distance * (np.cos(above) * level + np.sin(above) * up), look_at


def up_vector(up: str) -> NDArray[np.float64]:
    """Return the unit vector (3,) of an axis name such as `z` or `-y`."""
    return np.eye(3)["xyz".index(up[-1])] * (-1 if up.startswith("-") else 1)


def as_tuple(vector: ArrayLike) -> tuple[float, float, float]:
    """Return a vector (3,) as three floats."""
    x, y, z = (float(value) for value in np.asarray(vector))
    return x, y, z
