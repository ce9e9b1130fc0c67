# SPDX-License-Identifier: Apache-2.0
"""The occupied cells in space, with the camera's field of view as lines (Chien 2020, Fig 4.7)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import VoxelMap
from stereovox.view.drawn import UPS, Drawn, upright
from stereovox.view.figures import DPI, WIDTH, figure_of, headline
from stereovox.view.panels import PATH_COLOUR, oblique
from stereovox.view.picture import height_bar, height_colours
from stereovox.view.render import Direction

DEPTH_M = 1.0
"""Depth of the drawn field of view, as in the thesis."""
BEHIND_DEG, ABOVE_DEG = 32.0, 38.0
"""From where the map is seen: turned so far from straight behind the camera, and so far above the horizon."""


def draw_space(voxel_map: VoxelMap, heading: str, up: str) -> Any:
    """Return a figure of the occupied cells, seen from behind the camera and above, with its field of view in red.

    A ceiling is cut away. Raises StereovoxError for an empty map or an `up` that is no axis.
    """
    drawn = upright(voxel_map, None, up)
    if not len(drawn.below_ceiling):
        raise StereovoxError("the map holds no occupied cell to draw; look at a layer instead (--view layer)")
    lines = None if voxel_map.viewpoint is None else field_of_view(voxel_map.viewpoint)
    lines = None if lines is None else _turned(lines, up)
    figure = figure_of(10.0)
    draw_cells(figure, figure.add_subplot(), drawn, lines)
    headline(figure, voxel_map, heading)
    return figure


def draw_cells(figure: Any, axis: Any, drawn: Drawn, lines: NDArray[np.float64] | None) -> None:
    """Draw cells coloured by height and lines (N, 2, 3), both with the third axis up."""
    colours, mappable = height_colours(drawn)
    direction = Direction.of(_azimuth(lines), ABOVE_DEG)
    oblique(axis, drawn, colours, direction, int(0.8 * WIDTH * DPI))
    for line in lines if lines is not None else ():
        axis.plot(*direction.flat(line).T, color=PATH_COLOUR, linewidth=2)
    height_bar(figure, axis, mappable, drawn)


def field_of_view(viewpoint: Viewpoint, depth_m: float = DEPTH_M) -> NDArray[np.float64]:
    """Return the edges (8, 2, 3) in metres, world frame, of the pyramid that the camera sees up to `depth_m`.

    First the four from the camera to the corners, then the four round the far side.
    """
    camera, T = viewpoint.camera, viewpoint.T_world_camera
    u, v = np.array([-0.5, camera.width - 0.5]), np.array([-0.5, camera.height - 0.5])
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    corners = np.array([[x[0], y[0], 1], [x[1], y[0], 1], [x[1], y[1], 1], [x[0], y[1], 1]]) * depth_m
    world = corners @ T[:3, :3].T + T[:3, 3]
    spokes = np.stack([np.broadcast_to(T[:3, 3], (4, 3)), world], axis=1)
    return np.concatenate([spokes, np.stack([world, np.roll(world, -1, axis=0)], axis=1)])


def _azimuth(lines: NDArray[np.float64] | None) -> float:
    """Return from where to look, in degrees: behind the camera and to its side."""
    if lines is None:
        return -60.0
    forward = (lines[:4, 1] - lines[:4, 0]).mean(axis=0)
    return float(np.degrees(np.arctan2(-forward[1], -forward[0]))) + BEHIND_DEG


def _turned(lines: NDArray[np.float64], up: str) -> NDArray[np.float64]:
    turned = lines[..., list(UPS[up])]
    return turned * [1, 1, -1] if up.startswith("-") else turned
