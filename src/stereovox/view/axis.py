# SPDX-License-Identifier: Apache-2.0
"""Log-odds along the optical axis of the camera (Chien 2020, Fig 4.6, top right)."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereovox.maps import VoxelMap
from stereovox.products.slices import along_ray
from stereovox.view.figures import figure_of, headline
from stereovox.view.layer import known_viewpoint
from stereovox.view.panels import GREY, INK, LINE, title


def draw_axis(voxel_map: VoxelMap, heading: str, length_m: float | None = None) -> Any:
    """Return a figure of the log-odds of the cells that the last frame's optical axis crosses.

    length_m: how far; by default the map's `max_range`. Raises StereovoxError where the map does not know its camera.
    """
    figure = figure_of(6.0)
    draw_profile(figure.add_subplot(), voxel_map, length_m)
    headline(figure, voxel_map, heading)
    return figure


def draw_profile(axis: Any, voxel_map: VoxelMap, length_m: float | None = None) -> None:
    """Draw one step a cell, with the limits of free and occupied; a map of bytes is drawn in bytes."""
    T = known_viewpoint(voxel_map).T_world_camera
    distance, log_odds = along_ray(voxel_map, T[:3, 3], T[:3, 2], length_m or voxel_map.config.max_range)
    limits = {name: getattr(voxel_map.config.map, name) for name in ("free_below", "occupied_above")}
    lines = np.array([np.log(p / (1 - p)) for p in limits.values()])
    values, unknown, label = log_odds, 0, "log-odds"
    if voxel_map.cell_format.unknown:
        values, lines = (voxel_map.cell_format.stored(numbers) for numbers in (log_odds, lines))
        unknown, label = voxel_map.cell_format.unknown, "cell value"
    axis.stairs(values, distance, baseline=unknown, fill=True, color="#9fb6d8", label="cells on the axis")
    axis.stairs(values, distance, baseline=unknown, color=INK, linewidth=1.3)
    for value, text in zip((lines[0], unknown, lines[1]), ("free below", "unknown", "occupied above"), strict=True):
        axis.axhline(value, color=GREY, linewidth=1, linestyle="--" if text != "unknown" else "-")
        axis.annotate(text, (1.0, value), xycoords=("axes fraction", "data"), xytext=(6, 0),
                      textcoords="offset points", va="center", color=GREY, fontsize=10)  # fmt: skip
    known = np.flatnonzero(log_odds)
    last = distance[min(known[-1] + 6, len(distance) - 1)] if len(known) else distance[-1]
    axis.set(xlim=(0, last), xlabel="distance from the camera [m]", ylabel=label)
    axis.tick_params(colors=GREY)
    for spine in axis.spines.values():
        spine.set_color(LINE)
    title(axis, "Along the optical axis")
