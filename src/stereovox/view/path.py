# SPDX-License-Identifier: Apache-2.0
"""Picture of a path through a map: from above, unrolled from the side, and the clearance along it.

Picture of one layer of a distance field: the distance to the nearest obstacle in colours and contours.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import State, VoxelMap
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.products.distance import DistanceField
from stereovox.products.floor_axes import floor_axes
from stereovox.products.floor_heights import FloorHeights
from stereovox.products.path_check import point_along
from stereovox.products.projection import from_above
from stereovox.view.drawn import UPS, checked_up, turned
from stereovox.view.figures import INK, PATH_COLOUR, STATE_COLOURS, WIDTH, figure_of, measured, save, title_above
from stereovox.view.grid import bounds, framed, legend, plan, trimmed

COLOURS = "viridis"
LINES = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Candidate intervals of contours in metres; there are at most MAX_LINES contours."""
MAX_LINES = 10


def picture_distance(
    field: DistanceField, path: str | Path, up: str = "z", at_m: float | None = None, title: str = "Distance field"
) -> None:
    """Write a PNG of the layer across `up` at height `at_m` in metres along it, by default the middle of the box.

    Obstacles are dark; contours connect places of equal distance. Raises StereovoxError for a height outside the box,
    and as `figures.save` does.
    """
    save(draw_distance(field, up, at_m, title), path)


def draw_distance(field: DistanceField, up: str, at_m: float | None, title: str) -> Any:
    """Return the matplotlib figure that `picture_distance` saves."""
    right, away, _ = UPS[checked_up(up)]
    _, _, height, sign = floor_axes(up)
    layer, at_m = _layer(field, height, sign, at_m)
    order = (right, away) if right < away else (away, right)
    metres, obstacles = (
        np.take(cells, layer, axis=height).transpose([order.index(away), order.index(right)])
        for cells in (field.metres, field.obstacles)
    )
    (left, bottom), sides = field.origin[[right, away]], field.cell[[right, away]]
    extent = (left, left + metres.shape[1] * sides[0], bottom, bottom + metres.shape[0] * sides[1])
    shape = (extent[3] - extent[2]) / (extent[1] - extent[0])
    figure = figure_of(float(np.clip(0.8 * WIDTH * shape, 3, 15)) + 1.6)
    axis = figure.add_subplot()
    shown = np.ma.masked_where(~np.isfinite(metres) | obstacles, metres)
    image = axis.imshow(shown, origin="lower", extent=extent, cmap=COLOURS, vmin=0)
    axis.imshow(np.ma.masked_where(~obstacles, obstacles), origin="lower", extent=extent, cmap="gray", vmin=0, vmax=9)
    _lines(axis, shown, extent)
    axis.set(xlabel=f"{'xyz'[right]} in metres", ylabel=f"{'xyz'[away]} in metres", facecolor="white")
    figure.colorbar(image, ax=axis, label="metres to the nearest obstacle", shrink=0.8)
    title_above(figure, title, [f"layer at {'-' if sign < 0 else ''}{'xyz'[height]} = {at_m:.2f} m", "obstacles dark"])
    return figure


def _layer(field: DistanceField, height: int, sign: int, at_m: float | None) -> tuple[int, float]:
    """Return the index of the layer at a height, and the height of its centre."""
    number, side = field.metres.shape[height], field.cell[height]
    layer = number // 2 if at_m is None else int(np.floor((sign * at_m - field.origin[height]) / side))
    if not 0 <= layer < number:
        ends = sorted(sign * (field.origin[height] + np.array([0, number]) * side) + 0.0)
        raise StereovoxError(f"height {at_m:g} m is outside the box, which is from {ends[0]:g} to {ends[1]:g} m")
    return layer, float(sign * (field.origin[height] + (layer + 0.5) * side))


def _lines(axis: Any, metres: np.ma.MaskedArray, extent: tuple[float, float, float, float]) -> None:
    if metres.mask.all() or min(metres.shape) < 2:
        return
    most = float(metres.max())
    step = next((step for step in LINES if most / step <= MAX_LINES), most / MAX_LINES)
    levels = np.arange(step, most, step)
    if len(levels):
        lines = axis.contour(metres, levels, origin="lower", extent=extent, colors="white", linewidths=0.8)
        axis.clabel(lines, fmt="%g m", fontsize=9)


STEPS = 400
"""Number of points along the path at which the clearance is measured."""
MORE_RADII = 3.0
"""The section reaches this many radii above and below the path."""
DRAWN_EVERY = 2.0
"""Distance in radii between drawings of the body along the path."""
MAX_BODIES = 100
NEAREST = {"obstacle": ([State.OCCUPIED, State.TENTATIVE], INK), "unknown cell": ([State.UNKNOWN], "tab:blue")}


def picture_path(
    voxel_map: VoxelMap,
    waypoints: ArrayLike,
    radius: float,
    path: str | Path,
    title: str,
    blocked_at: float | None = None,
) -> None:
    """Write a PNG of a path (N, 3) in metres, world frame, of a ball of `radius` metres.

    First the map from above, at the heights that the ball passes through; then the vertical section along the path,
    which shows what is above and below; then the distance of obstacles and unknown cells.
    blocked_at: metres along the path where it is blocked; this point is marked.
    In the first, a column is free if it is known to be free at all these heights. Raises as `figures.save`.
    """
    save(draw_path(voxel_map, np.asarray(waypoints, float), radius, title, blocked_at), path)


def draw_path(
    voxel_map: VoxelMap, waypoints: NDArray[np.float64], radius: float, title: str, blocked_at: float | None = None
) -> Any:
    """Return the matplotlib figure that `picture_path` saves."""
    up = voxel_map.config.up
    heights = turned(waypoints, up)[:, 2]
    room = max(radius, voxel_map.config.cell[UPS[up][2]])
    band = float(heights.min()) - room, float(heights.max()) + room
    plan_grid, flat = _plan(voxel_map, band, waypoints), waypoints[:, UPS[up][:2]]
    box = bounds(plan_grid, flat)
    assert box is not None  # it has a path
    (x0, y0), (x1, y1) = box
    tall = float(np.clip(0.92 * WIDTH * (y1 - y0) / (x1 - x0), 3, 12))
    figure = figure_of(tall + 7.6)
    above, aside, along = figure.subplots(3, 1, height_ratios=[tall, 3, 3])
    plan(above, trimmed(plan_grid) if (plan_grid.cells != UNKNOWN).any() else plan_grid, flat)
    names = "".join("xyz"[axis] for axis in UPS[up])
    measured(above, (names[0], names[1], names[2]))
    framed(above, box)
    length = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    places = np.array([point_along(waypoints, at) for at in np.linspace(0, length, STEPS)])
    _bodies(above, places[:, UPS[up][:2]], radius, length)
    _section(aside, voxel_map, places, radius, length)
    _room(along, voxel_map, places, radius, length)
    if blocked_at is not None:
        _mark(above, (aside, along), point_along(waypoints, blocked_at)[[*UPS[up][:2]]], blocked_at)
    caption = f"from above: cells {band[0]:.2f} to {band[1]:.2f} m high ({up}); the path may pass over or under them"
    above.set_title(caption, fontsize=11, color=INK)
    legend(figure, plan_grid.states, with_track=True)
    facts = [f"{length:.2f} m long", f"radius {radius:g} m", f"cells of {voxel_map.voxel_size:g} m"]
    if blocked_at is not None:
        facts.append(f"blocked after {blocked_at:.2f} m, at the cross")
    title_above(figure, title, facts)
    return figure


def _plan(voxel_map: VoxelMap, band: tuple[float, float], waypoints: NDArray[np.float64]) -> OccupancyGrid:
    """Return the map from above between two heights of its frame, however it is tilted; unknown if nothing is known."""
    side = voxel_map.config.cell[UPS[voxel_map.config.up][2]]
    below = FloorHeights.level(band[0] - side, voxel_map.config.up)  # the floor's own cell does not count
    found = from_above(voxel_map, (side, band[1] - band[0] + side), below)
    if found is not None:
        return found
    x, y = waypoints[0, UPS[voxel_map.config.up][:2]].tolist()
    return OccupancyGrid(np.full((1, 1), UNKNOWN, np.int8), voxel_map.voxel_size, (x, y, 0.0))


def _mark(above: Any, others: tuple[Any, ...], place: NDArray[np.float64], at: float) -> None:
    """Mark the point where the path is blocked."""
    above.plot(*place, marker="X", color=PATH_COLOUR, markeredgecolor="white", markersize=16, zorder=5)
    for axis in others:
        axis.axvline(at, color=PATH_COLOUR, linestyle=":")


def _bodies(axis: Any, places: NDArray[np.float64], radius: float, length: float) -> None:
    from matplotlib.patches import Circle

    number = int(np.clip(length / max(DRAWN_EVERY * radius, length / MAX_BODIES, 1e-9) + 1, 2, MAX_BODIES))
    for n in np.linspace(0, len(places) - 1, number).round().astype(int):
        axis.add_patch(Circle(tuple(places[n]), radius, fill=False, color=PATH_COLOUR, alpha=0.6))
    for place, label in ((places[0], "start"), (places[-1], "goal")):
        axis.annotate(
            label, tuple(place), textcoords="offset points", xytext=(-12, -20), fontsize=13, color=PATH_COLOUR
        )


def _section(axis: Any, voxel_map: VoxelMap, places: NDArray[np.float64], radius: float, length: float) -> None:
    """Draw the states of the cells above and below the path, unrolled, and the space of the body."""
    from matplotlib.colors import ListedColormap

    up = voxel_map.config.up
    _, _, upright, sign = floor_axes(up)
    side = voxel_map.config.cell[upright]
    height = turned(places, up)[:, 2]
    more = MORE_RADII * max(radius, side)
    low, high = height.min() - more, height.max() + more
    rows = np.arange(low, high, side / 2)
    points = np.repeat(places[None], len(rows), axis=0)
    points[:, :, upright] = sign * rows[:, None]
    states = voxel_map.state(points.reshape(-1, 3)).reshape(points.shape[:2])
    colours, extent = ListedColormap([STATE_COLOURS[state] for state in State]), (0, max(length, 1e-6), low, high)
    axis.imshow(states, cmap=colours, vmin=0, vmax=3, origin="lower", extent=extent, interpolation="nearest")
    at = np.linspace(0, length, len(places))
    axis.plot(at, height, color=PATH_COLOUR, linewidth=1.6)
    for edge in (height - radius, height + radius):
        axis.plot(at, edge, color=PATH_COLOUR, linestyle="--", linewidth=1)
    axis.set(ylabel=f"height ({up}) [m]", aspect="auto")
    axis.set_title("straight above and below the path; dashed: how far the body reaches", fontsize=11, color=INK)


def _room(axis: Any, voxel_map: VoxelMap, places: NDArray[np.float64], radius: float, length: float) -> None:
    at = np.linspace(0, length, len(places))
    for what, (states, colour) in NEAREST.items():
        away = voxel_map.nearest_obstacle(places, np.inf, states).distance
        axis.plot(at, away, color=colour, label=f"nearest {what}")
    axis.axhline(radius, color=PATH_COLOUR, linestyle="--", label="radius")
    axis.set(xlabel="metres along the path", ylabel="metres away", xlim=(0, max(length, 1e-6)), ylim=(0, None))
    axis.legend(loc="lower right")
    axis.grid(alpha=0.3)
