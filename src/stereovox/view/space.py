# SPDX-License-Identifier: Apache-2.0
"""Occupied cells in 3-D, with the camera's field of view as lines (Chien 2020, Fig 4.7)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import VoxelMap
from stereovox.view.drawn import FIELD_M, Drawn, checked_up, field_of_view, turned, upright
from stereovox.view.figures import DPI, GREY, LINE, PATH_COLOUR, WIDTH, figure_of, headline, round_length, title
from stereovox.view.picture import height_bar, height_colours
from stereovox.view.render import Direction, Rendering, render

Numbers = tuple[str, NDArray[np.float64], NDArray[np.float64]]
"""Label of an edge, its ticks in metres, and their numbers."""
BEHIND_DEG, ABOVE_DEG = 32.0, 38.0
"""Direction of view: angle from straight behind the camera, and above the horizon."""
DOTS = 300
"""Number of points of a line tested for being hidden by cells."""


def numbers(label: str, low: float, high: float, least_m: float = 1e-6) -> Numbers:
    """Return round numbers between `low` and `high`, about `least_m` or more apart, for the edge `label`."""
    step = round_length(max((high - low) / 4, least_m))
    at = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step + 0.0  # no "-0"
    return label, at, at


def draw_frame(
    axis: Any, direction: Direction, low: ArrayLike, high: ArrayLike, edges: tuple[Numbers, Numbers, Numbers]
) -> None:
    """Draw floor and edges of the box from `low` to `high` (3,) in metres, below all else, and number three edges."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    front = np.where(direction.toward > 0, high, low)
    back = np.where(direction.toward > 0, low, high)
    floor = np.array([low[:2], [high[0], low[1]], high[:2], [low[0], high[1]]])
    corners = np.column_stack([floor, np.full(4, low[2])])
    room = 0.04 * float((high - low).max())
    axis.fill(*direction.flat(corners).T, facecolor="#f3f4f6", edgecolor=LINE, linewidth=0.8, zorder=0)
    for n, across in ((0, 1), (1, 0)):
        for at in edges[n][1]:
            line = np.array([low, low])
            line[:, n], line[0, across], line[1, across] = at, low[across], high[across]
            axis.plot(*direction.flat(line).T, color="#dfe2e7", linewidth=0.7, zorder=0)
        start = np.array([front[0], front[1], low[2]])
        _edge(axis, direction, n, start, _inner(edges[n], low[n], high[n], room), np.array([*(front - back)[:2], 0.0]))
    left = corners[np.argmin(direction.flat(corners)[:, 0])]
    _edge(axis, direction, 2, left, edges[2], -direction.right * np.ptp([low, high], axis=0).max())
    axis.plot(*direction.flat(np.array([left, [*left[:2], high[2]]])).T, color=LINE, linewidth=0.8, zorder=0)


def fit(axis: Any, direction: Direction, low: ArrayLike, high: ArrayLike, margin: float = 0.09) -> float:
    """Fit the view to the whole box with room for its numbers, without axes; return height divided by width."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    flat = direction.flat(corners)
    size = np.ptp(flat, axis=0)
    space = margin * size.max()
    (left, bottom), (right, top) = flat.min(0) - space, flat.max(0) + np.array([space, 0.15 * space])
    axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axis.set_axis_off()
    return float((top - bottom) / (right - left))


def _inner(edge: Numbers, low: float, high: float, room: float) -> Numbers:
    """Return an edge without the numbers at its ends, where its neighbours' numbers are."""
    label, places, values = edge
    kept = (places >= low + room) & (places <= high - room)
    return label, places[kept], values[kept]


def _edge(
    axis: Any, direction: Direction, n: int, start: NDArray[np.float64], edge: Numbers, outward: NDArray[np.float64]
) -> None:
    label, places, values = edge
    away = direction.flat(_without(outward, n)[None])[0]
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    points = np.repeat(start[None], len(places), axis=0)
    points[:, n] = places
    for (x, y), value in zip(direction.flat(points), values, strict=True):
        _text(axis, (x, y), f"{value:g}", 11 * away, 9)
    middle = np.array(points.mean(0) if len(points) else start)
    _text(axis, tuple(direction.flat(middle[None])[0]), label, 44 * away, 10.5, 90 if n == 2 else 0)


def _without(vector: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    rest = vector.copy()
    rest[n] = 0
    return rest


def _text(
    axis: Any, at: tuple[float, float], text: str, offset: NDArray[np.float64], size: float, turn: float = 0
) -> None:
    axis.annotate(text, at, xytext=tuple(offset), textcoords="offset points", ha="center", va="center",
                  fontsize=size, color=GREY, rotation=turn, annotation_clip=False)  # fmt: skip


def draw_space(
    voxel_map: VoxelMap,
    heading: str,
    up: str,
    viewpoint: Viewpoint | None = None,
    counted: VoxelMap | None = None,
) -> Any:
    """Return a figure of the occupied cells, seen from behind the camera and above, with its field of view in red.

    viewpoint: by default the map's last; without one the lines are left out. A ceiling is hidden.
    counted: as for `draw_view`. Raises StereovoxError for a map without occupied cells or an invalid `up`.
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
    headline(figure, counted or voxel_map, heading)
    return figure


def draw_cells(figure: Any, axis: Any, drawn: Drawn, lines: NDArray[np.float64] | None) -> float:
    """Draw cells coloured by height, and lines (N, 2, 3), both with the third axis up; return height over width."""
    colours, mappable = height_colours(drawn)
    direction = Direction.of(_azimuth(lines), ABOVE_DEG)
    width_px = int(0.85 * WIDTH * DPI)
    rendering = render(drawn.below_ceiling, colours, drawn.voxel_size, direction, width_px, width_px, drawn.occlusion)
    axis.imshow(rendering.image, extent=rendering.extent, interpolation="antialiased", zorder=2)
    corners = [drawn.below_ceiling.min(0) * drawn.voxel_size, (drawn.below_ceiling.max(0) + 1) * drawn.voxel_size]
    corners = np.concatenate([corners, *([] if lines is None else [lines.reshape(-1, 3)])])
    low, high = corners.min(0), corners.max(0)
    shape = fit(axis, direction, low, high)
    least = 0.04 * float((high - low).max())  # else the numbers of a flat map would overlap
    edges = [numbers(f"{name} [m]", a, b, least) for name, a, b in zip(drawn.names, low, high, strict=True)]
    draw_frame(axis, direction, low, high, (edges[0], edges[1], edges[2]))
    for line in lines if lines is not None else ():
        _line(axis, line, direction, rendering, drawn.voxel_size)
    if lines is not None:
        _eye(axis, lines[:1, 0], direction, rendering, drawn.voxel_size)
    height_bar(figure, axis, mappable, drawn)
    return shape


def _line(axis: Any, line: NDArray[np.float64], direction: Direction, rendering: Rendering, slack: float) -> None:
    """Draw a line (2, 3), strong where visible, dashed and pale behind cells."""
    points = line[0] + np.linspace(0, 1, DOTS)[:, None] * (line[1] - line[0])
    flat = direction.flat(points)
    hidden = rendering.hidden(flat, points @ direction.toward, slack)
    axis.plot(*np.where(hidden[:, None], flat, np.nan).T, color=PATH_COLOUR, linewidth=1.1, alpha=0.55, zorder=3,
              linestyle=(0, (4, 3)))  # fmt: skip
    axis.plot(*np.where(hidden[:, None], np.nan, flat).T, color=PATH_COLOUR, linewidth=2.2, zorder=4)


def _eye(axis: Any, place: NDArray[np.float64], direction: Direction, rendering: Rendering, slack: float) -> None:
    """Draw the camera at `place` (1, 3) as a dot, or as a ring behind cells."""
    flat = direction.flat(place)
    behind = rendering.hidden(flat, place @ direction.toward, slack)[0]
    fill, edge = ("none", PATH_COLOUR) if behind else (PATH_COLOUR, "white")
    axis.plot(*flat.T, "o", color=PATH_COLOUR, markerfacecolor=fill, markeredgecolor=edge, markersize=8, zorder=5)


def _azimuth(lines: NDArray[np.float64] | None) -> float:
    """Return the azimuth of the view in degrees: behind the camera and to its side."""
    if lines is None:
        return -60.0
    forward = (lines[:4, 1] - lines[:4, 0]).mean(axis=0)
    return float(np.degrees(np.arctan2(-forward[1], -forward[0]))) + BEHIND_DEG
