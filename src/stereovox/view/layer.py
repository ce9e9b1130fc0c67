# SPDX-License-Identifier: Apache-2.0
"""Pictures of the log-odds of a map: one layer in colours and as a landscape, and the values along the optical axis.

As Chien 2020, Fig 4.6. Colours show log-odds, or the bytes that a map stores.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.frame import Viewpoint
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellFormat, CellRules
from stereovox.products.floor_axes import Layer, along_ray, layer
from stereovox.view.drawn import FIELD_M, UPS, checked_up, known_viewpoint, upright
from stereovox.view.figures import (
    DPI,
    GREY,
    INK,
    LINE,
    PATH_COLOUR,
    STATE_COLOURS,
    WIDTH,
    figure_of,
    headline,
    keep_clear,
    measured,
    round_length,
    title,
)
from stereovox.view.render import Direction, Occlusion, render
from stereovox.view.space import draw_frame, fit, numbers

COLOURS = ("#1f5f8b", "#6fa8c9", "#eef0ee", "#e8a27a", "#c23b2a")
"""From certainly free to certainly occupied, at equal steps; the middle means no evidence."""


@dataclass(frozen=True)
class Scale:
    """How a map's log-odds are displayed.

    label: name of the numbers; unknown, free_below, occupied_above, lowest, highest: in these numbers.
    """

    label: str
    cell_format: CellFormat
    unknown: float
    free_below: float
    occupied_above: float
    lowest: float
    highest: float

    def shown(self, log_odds: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the numbers to show for log-odds of any shape; NaN stays NaN."""
        values = np.asarray(log_odds, float)
        if not self.unknown:
            return values
        return np.where(np.isnan(values), np.nan, self.cell_format.stored(np.nan_to_num(values)))

    def colours(self) -> tuple[Any, Any]:
        """Return matplotlib's colour map and norm; no evidence is in the middle."""
        from matplotlib.colors import LinearSegmentedColormap, Normalize

        reach = max(self.highest - self.unknown, self.unknown - self.lowest)
        colours = LinearSegmentedColormap.from_list("log-odds", COLOURS)
        return colours, Normalize(self.unknown - reach, self.unknown + reach)


def scale_of(voxel_map: VoxelMap) -> Scale:
    """Return the scale of a map: log-odds, or bytes for a map that keeps bytes (Chien 2020, 3.5)."""
    rules = CellRules(voxel_map.config.map)
    cell_format = rules.format
    in_bytes = bool(cell_format.unknown)
    unit = 1.0 if in_bytes else cell_format.per_log_odds
    numbers = (rules.free_below, rules.occupied_above, float(rules.lowest), float(rules.highest))
    label = f"cell value ({cell_format.unknown}: unknown)" if in_bytes else "log-odds"
    return Scale(label, cell_format, float(cell_format.unknown), *(number / unit for number in numbers))


MAX_COLUMNS = 160
"""Cells along a side; larger layers are thinned, keeping the value farthest from unknown."""
TALL = 0.3
"""Height of the landscape as a share of its longer side."""
WIDE_PX = 8 * DPI
FROM = Direction.of(-115, 40)


def draw_landscape(axis: Any, one: Layer, voxel_map: VoxelMap) -> None:
    """Draw one column per cell, as high as its log-odds (bytes if the map has them); unknown cells are grey."""
    from matplotlib.colors import to_rgb

    scale = scale_of(voxel_map)
    values, step = thinned(scale.shown(one.log_odds), scale.unknown)
    levels = max(8, round(TALL * max(values.shape)))
    heights = _levels(values, scale, levels)
    cells = columns(heights)
    colours, norm = scale.colours()
    painted = colours(norm(np.nan_to_num(values, nan=scale.unknown)))[..., :3]
    painted[np.isnan(values)] = to_rgb(STATE_COLOURS[State.UNKNOWN])
    size = voxel_map.voxel_size * step
    plain = Occlusion(cells, ())  # its heights are no surface
    rendering = render(cells, painted[cells[:, 1], cells[:, 0]], size, FROM, WIDE_PX, WIDE_PX, plain)
    axis.imshow(rendering.image, extent=rendering.extent, interpolation="antialiased", zorder=2)
    _frame(axis, one, scale, np.array([*values.shape[::-1], levels]) * size)
    title(axis, f"{'Log-odds' if scale.unknown == 0 else 'Cell values'} as height")


def thinned(values: NDArray[np.float64], unknown: float) -> tuple[NDArray[np.float64], int]:
    """Return values (rows, columns), NaN unknown, each for step by step cells, and the step."""
    step = max(1, -(-max(values.shape) // MAX_COLUMNS))
    if step == 1:
        return values, 1
    rows, across = (-(-size // step) for size in values.shape)
    padded = np.full((rows * step, across * step), np.nan)
    padded[: values.shape[0], : values.shape[1]] = values
    blocks = padded.reshape(rows, step, across, step).swapaxes(1, 2).reshape(rows, across, -1)
    furthest = np.argmax(np.where(np.isnan(blocks), -1, np.abs(blocks - unknown)), axis=-1)
    return np.take_along_axis(blocks, furthest[..., None], axis=-1)[..., 0], step


def columns(heights: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the cells (N, 3) of columns of these heights (rows, columns) >= 1, without hidden ones."""
    around = np.pad(heights, 1)
    sides = (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:])
    lowest = np.minimum(np.minimum.reduce(sides), heights - 1)
    number = (heights - lowest).ravel()
    column = np.repeat(np.arange(heights.size), number)
    level = np.arange(len(column)) - np.repeat(np.cumsum(number) - number, number) + lowest.ravel()[column]
    row, across = np.divmod(column, heights.shape[1])
    return np.stack([across, row, level], axis=1)


def _levels(values: NDArray[np.float64], scale: Scale, levels: int) -> NDArray[np.int64]:
    """Return heights (rows, columns) from 1 to `levels`, unknown at its place between them."""
    share = (np.nan_to_num(values, nan=scale.unknown) - scale.lowest) / (scale.highest - scale.lowest)
    return np.clip(np.rint(1 + share * (levels - 1)), 1, levels).astype(np.int64)


def _frame(axis: Any, one: Layer, scale: Scale, size: NDArray[np.float64]) -> None:
    left, right, bottom, top = one.extent
    x, y = numbers(f"{one.axes[0]} [m]", left, right), numbers(f"{one.axes[1]} [m]", bottom, top)
    span = scale.highest - scale.lowest
    step = round_length(span / 3)
    ticks = np.arange(np.ceil(scale.lowest / step), np.floor(scale.highest / step) + 1) * step + 0.0
    heights = (ticks - scale.lowest) / span * size[2]
    edges = ((x[0], x[1] - left, x[2]), (y[0], y[1] - bottom, y[2]), (scale.label, heights, ticks))
    fit(axis, FROM, np.zeros(3), size)
    draw_frame(axis, FROM, np.zeros(3), size, edges)


BEYOND = 6
"""Number of cells drawn after the last known one."""


def draw_axis(
    voxel_map: VoxelMap,
    heading: str,
    length_m: float | None = None,
    viewpoint: Viewpoint | None = None,
    counted: VoxelMap | None = None,
) -> Any:
    """Return a figure of the log-odds of the cells along the camera's optical axis.

    length_m: length of the axis; by default the map's `max_range`. viewpoint: by default the map's last.
    counted: as for `draw_view`. Raises StereovoxError if the camera is not known.
    """
    figure = figure_of(6.5)
    axis = figure.add_subplot()
    hit = draw_profile(axis, voxel_map, length_m, viewpoint)
    reached = "no cell is occupied" if hit is None else f"first occupied from {hit[0]:.2f} to {hit[1]:.2f} m"
    title(axis, f"Along the optical axis: {reached}")
    axis.legend(loc="lower right", bbox_to_anchor=(1.005, 1), ncols=4, frameon=False, fontsize=10, borderaxespad=0.3)
    headline(figure, counted or voxel_map, heading)
    return figure


def draw_profile(
    axis: Any, voxel_map: VoxelMap, length_m: float | None = None, viewpoint: Viewpoint | None = None
) -> tuple[float, float] | None:
    """Draw one step per cell in its state's colour, with the thresholds; in bytes if the map has them.

    Returns the start and end of the first occupied cells in metres, None if missing.
    """
    T = known_viewpoint(viewpoint or voxel_map.viewpoint).T_world_camera
    distance, log_odds = along_ray(voxel_map, T[:3, 3], T[:3, 2], length_m or voxel_map.config.max_range)
    scale = scale_of(voxel_map)
    values = scale.shown(log_odds)
    _steps(axis, distance, values, scale)
    known = np.flatnonzero(log_odds)
    last = distance[min(known[-1] + BEYOND, len(distance) - 1)] if len(known) else distance[-1]
    room = 0.06 * (scale.highest - scale.lowest)
    axis.set(xlim=(0, last), ylim=(scale.lowest - room, scale.highest + room))
    axis.set_xlabel("distance from the camera along its optical axis [m]", color=GREY)
    axis.set_ylabel(scale.label, color=GREY)
    axis.tick_params(colors=GREY)
    for spine in axis.spines.values():
        spine.set_color(LINE)
    title(axis, "Along the optical axis")
    return _first_hit(distance, values, scale)


def _steps(axis: Any, distance: NDArray[np.float64], values: NDArray[np.float64], scale: Scale) -> None:
    of_state = {
        State.FREE: values < scale.free_below,
        State.OCCUPIED: values > scale.occupied_above,
        State.TENTATIVE: (values >= scale.free_below) & (values <= scale.occupied_above) & (values != scale.unknown),
    }
    axis.stairs(values, distance, baseline=scale.unknown, color=INK, linewidth=1.3, label="cells on the axis")
    for state, mine in of_state.items():
        height = np.where(mine, values, scale.unknown)
        colour = "#dcd7bd" if state is State.FREE else STATE_COLOURS[state]  # a free cell's own colour is nearly white
        if mine.any():
            axis.stairs(height, distance, baseline=scale.unknown, fill=True, color=colour, label=state.name.lower())
    limits = ((scale.free_below, "free below"), (scale.unknown, "unknown"), (scale.occupied_above, "occupied above"))
    for value, text in limits:
        axis.axhline(value, color=GREY, linewidth=1, linestyle="-" if text == "unknown" else "--")
        axis.annotate(f"{text} {value:.3g}", (1.0, value), xycoords=("axes fraction", "data"), xytext=(6, 0),
                      textcoords="offset points", va="center", color=GREY, fontsize=10)  # fmt: skip


def _first_hit(distance: NDArray[np.float64], values: NDArray[np.float64], scale: Scale) -> tuple[float, float] | None:
    hits = np.flatnonzero(values > scale.occupied_above)
    if not len(hits):
        return None
    run = hits[: int(np.argmax(np.append(np.diff(hits), 2) > 1)) + 1]
    return float(distance[run[0]]), float(distance[run[-1] + 1])


MAX_SQUARES = 90
"""Largest number of columns in which cells are drawn as outlined squares."""


def draw_layer(
    voxel_map: VoxelMap,
    heading: str,
    up: str,
    at_m: float | None = None,
    viewpoint: Viewpoint | None = None,
    counted: VoxelMap | None = None,
) -> Any:
    """Return a figure of one layer: states, log-odds as colours, log-odds as a landscape, and along the optical axis.

    at_m: height in metres along `up`; by default the camera's, or without one the most informative layer's.
    viewpoint: by default the map's last. counted: as for `draw_view`.
    Raises StereovoxError for an empty map or an invalid `up`.
    """
    viewpoint = viewpoint or voxel_map.viewpoint
    up = checked_up(up)
    one = upright_layer(voxel_map, up, shown_height(voxel_map, up, viewpoint) if at_m is None else at_m)
    rows, columns = one.state.shape
    plan_height = float(np.clip(0.44 * WIDTH * rows / columns, 2.5, 8.0)) + 0.9
    figure = figure_of(plan_height + 6.3)
    grid = figure.add_gridspec(2, 1, height_ratios=[plan_height, 5.4])
    plans, below = grid[0].subgridspec(1, 2), grid[1].subgridspec(1, 2, width_ratios=[1, 0.8])
    plan = figure.add_subplot(plans[0])
    draw_plan(plan, one, viewpoint)
    draw_values(figure, figure.add_subplot(plans[1]), one, voxel_map, viewpoint)
    draw_landscape(figure.add_subplot(below[0] if viewpoint else grid[1]), one, voxel_map)
    if viewpoint is not None:
        draw_profile(figure.add_subplot(below[1]), voxel_map, None, viewpoint)
    keep_clear(plan)
    headline(figure, counted or voxel_map, heading)
    return figure


def upright_layer(voxel_map: VoxelMap, up: str, at_m: float) -> Layer:
    """Return the layer at height `at_m` along `up`, seen from above, never mirrored; `across` is `up` as given."""
    sign = -1.0 if up.startswith("-") else 1.0
    one = layer(voxel_map, up[-1], sign * at_m)
    names = ("xyz"[UPS[up][0]], "xyz"[UPS[up][1]])
    if one.axes != names:
        left, right, bottom, top = one.extent
        one = replace(one, log_odds=one.log_odds.T, state=one.state.T, extent=(bottom, top, left, right), axes=names)
    return replace(one, across=up, at_m=sign * one.at_m)


def draw_plan(axis: Any, one: Layer, viewpoint: Viewpoint | None = None) -> None:
    """Draw the states of a layer as squares, and the camera with its field of view, one metre deep."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    colours = ListedColormap([STATE_COLOURS[state] for state in State])
    axis.imshow(one.state, cmap=colours, vmin=0, vmax=3, origin="lower", extent=one.extent, interpolation="nearest")
    _squares(axis, one)
    if viewpoint is not None:
        _camera(axis, one, viewpoint)
    patches = [Patch(fc=STATE_COLOURS[state], ec="#888", label=state.name.lower()) for state in State]
    axis.legend(handles=patches, loc="lower right", bbox_to_anchor=(1.01, 1), ncols=4, frameon=False, fontsize=10,
                borderaxespad=0.3, handlelength=1.1, handletextpad=0.4, columnspacing=0.9)  # fmt: skip
    title(axis, f"States, {_where(one)}")
    measured(axis, (*one.axes, one.across))


def draw_values(figure: Any, axis: Any, one: Layer, voxel_map: VoxelMap, viewpoint: Viewpoint | None = None) -> None:
    """Draw the log-odds of a layer in colours with a colour bar; unknown cells are grey."""
    scale = scale_of(voxel_map)
    colours, norm = scale.colours()
    drawn = axis.imshow(
        scale.shown(one.log_odds), cmap=colours, norm=norm, origin="lower", extent=one.extent, interpolation="nearest"
    )
    axis.set_facecolor(STATE_COLOURS[State.UNKNOWN])
    _squares(axis, one)
    if viewpoint is not None:
        _camera(axis, one, viewpoint)
    bar = figure.colorbar(drawn, ax=axis, pad=0.02, fraction=0.04, aspect=22)
    bar.set_label(f"free  <  {scale.label}  <  occupied", color=GREY)
    bar.ax.tick_params(colors=GREY)
    bar.ax.set_ylim(scale.lowest, scale.highest)
    bar.outline.set_visible(False)
    title(axis, "Log-odds of the same layer" if scale.unknown == 0 else "Cell values of the same layer")
    measured(axis, (*one.axes, one.across))


def shown_height(voxel_map: VoxelMap, up: str, viewpoint: Viewpoint | None) -> float:
    """Return the height in metres along `up` of the layer to show: the camera's, or the most informative one."""
    if viewpoint is None:
        drawn = upright(voxel_map, None, up)
        return (drawn.layer + 0.5) * voxel_map.voxel_size if len(drawn.cells) else 0.0
    height = float(viewpoint.T_world_camera["xyz".index(up[-1]), 3])
    return -height if up.startswith("-") else height


def _where(one: Layer) -> str:
    size = (one.extent[1] - one.extent[0]) / one.state.shape[1]
    low, high = (round(one.at_m + side * size, 3) + 0.0 for side in (-0.5, 0.5))  # + 0.0: no "-0.00"
    return f"{one.across} = {low:.2f} to {high:.2f} m"


def _squares(axis: Any, one: Layer) -> None:
    """Outline the cells if they are large enough to be distinguished."""
    rows, columns = one.state.shape
    if max(rows, columns) > MAX_SQUARES:
        return
    left, right, bottom, top = one.extent
    axis.vlines(np.linspace(left, right, columns + 1), bottom, top, color=LINE, linewidth=0.5)
    axis.hlines(np.linspace(bottom, top, rows + 1), left, right, color=LINE, linewidth=0.5)


def _camera(axis: Any, one: Layer, viewpoint: Viewpoint) -> None:
    """Draw camera, optical axis and the sides of the field of view: strong up to one metre, faint beyond."""
    columns, rows = ("xyz".index(name) for name in one.axes)
    camera, T = viewpoint.camera, viewpoint.T_world_camera
    slopes = [(u - camera.cx) / camera.fx for u in (-0.5, camera.width - 0.5)]
    rays = [T[:3, :3] @ np.array([x, 0.0, 1.0]) for x in (*slopes, 0.0)]
    position, *ends = ((T[:3, 3] + ray)[[columns, rows]] for ray in (np.zeros(3), *(FIELD_M * ray for ray in rays)))
    for end in ends[:2]:
        axis.plot(*np.array([position, end]).T, color=PATH_COLOUR, linewidth=2.2)
    axis.fill(*np.array([position, *ends[:2]]).T, color=PATH_COLOUR, alpha=0.15, linewidth=0)
    for end, style in zip(ends, ("-", "-", "--"), strict=True):
        far = _stretched(position, end, one)
        axis.plot(*np.array([position, far]).T, color=PATH_COLOUR, linewidth=1, alpha=0.55, linestyle=style)
    axis.plot(*position, "o", color=PATH_COLOUR, markeredgecolor="white", markersize=9, clip_on=False, zorder=5)
    axis.set(xlim=one.extent[:2], ylim=one.extent[2:])


def _stretched(start: NDArray[np.float64], end: NDArray[np.float64], one: Layer) -> NDArray[np.float64]:
    """Return a point on the ray from `start` through `end`, beyond the layer."""
    reach = float(np.hypot(one.extent[1] - one.extent[0], one.extent[3] - one.extent[2]))
    length = float(np.linalg.norm(end - start))
    return end if length < 1e-6 else start + (end - start) * min(reach / length, 1e4)
