# SPDX-License-Identifier: Apache-2.0
"""One layer of a map: its states as a plan, and its log-odds as a landscape (Chien 2020, Fig 4.6)."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import State, VoxelMap
from stereovox.products.slices import Layer, layer
from stereovox.view.drawn import UPS
from stereovox.view.figures import figure_of, headline
from stereovox.view.panels import GREY, PATH_COLOUR, STATE_COLOURS, measured, title

WEDGE_M = 1.0
"""Length of the field of view's sides in a plan, as in the thesis."""
MOST_STEPS = 150
"""Rows and columns of the landscape; larger layers are thinned."""


def draw_layer(voxel_map: VoxelMap, heading: str, up: str, at_m: float | None = None) -> Any:
    """Return a figure of the layer across `up` at `at_m` metres; by default at the height of the camera.

    Raises StereovoxError where no height is given and the map does not know its camera, or `up` is no axis.
    """
    if up not in UPS:
        raise StereovoxError(f"up '{up}' is no axis; name one of {', '.join(UPS)}")
    across = up[-1]
    if at_m is None:
        at_m = float(known_viewpoint(voxel_map).T_world_camera["xyz".index(across), 3])
    one = layer(voxel_map, across, at_m)
    figure = figure_of(7.5)
    plan, land = figure.add_gridspec(1, 2, width_ratios=[1, 1.15])
    draw_plan(figure.add_subplot(plan), one, voxel_map.viewpoint)
    draw_landscape(figure.add_subplot(land, projection="3d"), one, voxel_map)
    headline(figure, voxel_map, heading)
    return figure


def draw_plan(axis: Any, one: Layer, viewpoint: Viewpoint | None = None) -> None:
    """Draw the states of a layer, and in it the camera with the sides of its field of view, one metre long."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    colours = ListedColormap([STATE_COLOURS[state] for state in State])
    axis.imshow(one.state, cmap=colours, vmin=0, vmax=3, origin="lower", extent=one.extent, interpolation="nearest")
    if viewpoint is not None:
        _camera(axis, one, viewpoint)
    patches = [Patch(fc=colour, ec="#888", label=state.name.lower()) for state, colour in STATE_COLOURS.items()]
    axis.legend(handles=patches, loc="lower right", bbox_to_anchor=(1.005, 1), ncols=4, frameon=False, fontsize=10)
    title(axis, f"Layer at {one.across} = {one.at_m:.2f} m")
    measured(axis, (*one.axes, one.across))


def draw_landscape(axis: Any, one: Layer, voxel_map: VoxelMap) -> None:
    """Draw log-odds as height; unknown cells lie at zero. A layer in bytes is labelled in bytes."""
    step = max(1, -(-max(one.state.shape) // MOST_STEPS))
    values, label = np.nan_to_num(one.log_odds)[::step, ::step], "log-odds"
    cell_format = voxel_map.cell_format
    if cell_format.unknown:
        values, label = cell_format.stored(values), "cell value (127 unknown)"
    left, right, bottom, top = one.extent
    size = voxel_map.voxel_size * step
    x = left + size * (np.arange(values.shape[1]) + 0.5)
    y = bottom + size * (np.arange(values.shape[0]) + 0.5)
    axis.plot_surface(*np.meshgrid(x, y), values, cmap="viridis", rcount=MOST_STEPS, ccount=MOST_STEPS, linewidth=0)
    axis.set_box_aspect((right - left, top - bottom, 0.4 * max(right - left, top - bottom)), zoom=0.88)
    axis.view_init(38, -70)
    axis.set_xlabel(f"{one.axes[0]} [m]", color=GREY)
    axis.set_ylabel(f"{one.axes[1]} [m]", color=GREY)
    axis.set_zlabel(label, color=GREY)
    title(axis, "Log-odds of the same layer")


def known_viewpoint(voxel_map: VoxelMap) -> Viewpoint:
    """Return where the camera of a map stood last; raises StereovoxError where the map does not know."""
    if voxel_map.viewpoint is None:
        raise StereovoxError("the map does not know where its camera stood; give --at, or make the map anew")
    return voxel_map.viewpoint


def _camera(axis: Any, one: Layer, viewpoint: Viewpoint) -> None:
    columns, rows = ("xyz".index(name) for name in one.axes)
    camera, T = viewpoint.camera, viewpoint.T_world_camera
    sides = [(u - camera.cx) / camera.fx for u in (-0.5, camera.width - 0.5)]
    position = T[:3, 3]
    for x in sides:
        end = position + WEDGE_M * (T[:3, :3] @ [x, 0.0, 1.0])
        axis.plot([position[columns], end[columns]], [position[rows], end[rows]], color=PATH_COLOUR, linewidth=1.8)
    axis.plot(position[columns], position[rows], "o", color=PATH_COLOUR, markeredgecolor="white", markersize=9)
