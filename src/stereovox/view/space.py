# SPDX-License-Identifier: Apache-2.0
"""The occupied cells in space, with the camera's field of view as lines (Chien 2020, Fig 4.7)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import VoxelMap
from stereovox.view.drawn import Drawn, checked_up, turned, upright
from stereovox.view.figures import DPI, WIDTH, figure_of, headline
from stereovox.view.frame3d import draw_frame, fit, numbers
from stereovox.view.panels import PATH_COLOUR, title
from stereovox.view.picture import height_bar, height_colours
from stereovox.view.render import Direction, Rendering, render
from stereovox.view.whereabouts import FIELD_M, field_of_view

BEHIND_DEG, ABOVE_DEG = 32.0, 38.0
"""From where the map is seen: turned so far from straight behind the camera, and so far above the horizon."""
DOTS = 300
"""Points of a line at which it is asked whether cells hide it."""


def draw_space(voxel_map: VoxelMap, heading: str, up: str, viewpoint: Viewpoint | None = None) -> Any:
    """Return a figure of the occupied cells, seen from behind the camera and above, with its field of view in red.

    viewpoint: by default the map's last; the lines are left out where nobody knows it. A ceiling is cut away.
    Raises StereovoxError for a map without occupied cells or an `up` that is no axis.
    """
    up = checked_up(up)
    viewpoint = viewpoint or voxel_map.viewpoint
    drawn = upright(voxel_map, None, up)
    if not len(drawn.below_ceiling):
        raise StereovoxError("the map holds no occupied cell to draw; look at a layer instead (--view layer)")
    lines = None if viewpoint is None else turned(field_of_view(viewpoint), up)
    figure = figure_of(9.0)
    axis = figure.add_subplot()
    shape = draw_cells(figure, axis, drawn, lines)
    figure.set_figheight(float(np.clip(0.86 * WIDTH * shape, 5.0, 12.0)) + 1.4)
    figure.get_layout_engine().set(rect=(0.015, 0.005, 0.98, 1 - 1.05 / figure.get_figheight()))
    cut = "" if drawn.cut is None else f", cut open at {drawn.names[2]} = {drawn.cut:.2f} m"
    seen = "" if lines is None else f"; red: the camera and its field of view, {FIELD_M:g} m deep, dashed behind cells"
    title(axis, f"Occupied cells{cut}{seen}")
    headline(figure, voxel_map, heading)
    return figure


def draw_cells(figure: Any, axis: Any, drawn: Drawn, lines: NDArray[np.float64] | None) -> float:
    """Draw cells coloured by height and lines (N, 2, 3), both with the third axis up; return height over width."""
    colours, mappable = height_colours(drawn)
    direction = Direction.of(_azimuth(lines), ABOVE_DEG)
    width_px = int(0.85 * WIDTH * DPI)
    rendering = render(drawn.below_ceiling, colours, drawn.voxel_size, direction, width_px, width_px)
    axis.imshow(rendering.image, extent=rendering.extent, interpolation="antialiased", zorder=2)
    corners = [drawn.below_ceiling.min(0) * drawn.voxel_size, (drawn.below_ceiling.max(0) + 1) * drawn.voxel_size]
    corners = np.concatenate([corners, *([] if lines is None else [lines.reshape(-1, 3)])])
    low, high = corners.min(0), corners.max(0)
    shape = fit(axis, direction, low, high)
    least = 0.04 * float((high - low).max())  # nearer, and the numbers of a flat map would cover each other
    edges = [numbers(f"{name} [m]", a, b, least) for name, a, b in zip(drawn.names, low, high, strict=True)]
    draw_frame(axis, direction, low, high, (edges[0], edges[1], edges[2]))
    for line in lines if lines is not None else ():
        _line(axis, line, direction, rendering, drawn.voxel_size)
    if lines is not None:
        _eye(axis, lines[:1, 0], direction, rendering, drawn.voxel_size)
    height_bar(figure, axis, mappable, drawn)
    return shape


def _line(axis: Any, line: NDArray[np.float64], direction: Direction, rendering: Rendering, slack: float) -> None:
    """Draw a line (2, 3), strong where it is seen, dashed and pale where cells stand before it."""
    points = line[0] + np.linspace(0, 1, DOTS)[:, None] * (line[1] - line[0])
    flat = direction.flat(points)
    hidden = rendering.hidden(flat, points @ direction.toward, slack)
    axis.plot(*np.where(hidden[:, None], flat, np.nan).T, color=PATH_COLOUR, linewidth=1.1, alpha=0.55, zorder=3,
              linestyle=(0, (4, 3)))  # fmt: skip
    axis.plot(*np.where(hidden[:, None], np.nan, flat).T, color=PATH_COLOUR, linewidth=2.2, zorder=4)


def _eye(axis: Any, place: NDArray[np.float64], direction: Direction, rendering: Rendering, slack: float) -> None:
    """Draw the camera at `place` (1, 3) as a dot, as a ring where cells stand before it."""
    flat = direction.flat(place)
    behind = rendering.hidden(flat, place @ direction.toward, slack)[0]
    fill, edge = ("none", PATH_COLOUR) if behind else (PATH_COLOUR, "white")
    axis.plot(*flat.T, "o", color=PATH_COLOUR, markerfacecolor=fill, markeredgecolor=edge, markersize=8, zorder=5)


def _azimuth(lines: NDArray[np.float64] | None) -> float:
    """Return from where to look, in degrees: behind the camera and to its side."""
    if lines is None:
        return -60.0
    forward = (lines[:4, 1] - lines[:4, 0]).mean(axis=0)
    return float(np.degrees(np.arctan2(-forward[1], -forward[0]))) + BEHIND_DEG
