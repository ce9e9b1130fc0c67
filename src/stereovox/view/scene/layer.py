# SPDX-License-Identifier: Apache-2.0
"""One layer of a map: its states as a plan, its log-odds in colours and as a landscape (Chien 2020, Fig 4.6)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.frame import Viewpoint
from stereovox.maps import State, VoxelMap
from stereovox.products.floor.slices import Layer, layer
from stereovox.view.figures import WIDTH, figure_of, headline, keep_clear
from stereovox.view.panels import GREY, LINE, PATH_COLOUR, STATE_COLOURS, measured, title
from stereovox.view.scene.axis import draw_profile
from stereovox.view.scene.drawn import UPS, checked_up, upright
from stereovox.view.scene.landscape import draw_landscape
from stereovox.view.scene.scale import scale_of
from stereovox.view.scene.viewpoint import FIELD_M

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
