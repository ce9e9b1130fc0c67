# SPDX-License-Identifier: Apache-2.0
"""Log-odds along the optical axis of the camera (Chien 2020, Fig 4.6, top right)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.frame import Viewpoint
from stereovox.maps import State, VoxelMap
from stereovox.products.floor.slices import along_ray
from stereovox.view.figures import figure_of, headline
from stereovox.view.panels import GREY, INK, LINE, STATE_COLOURS, title
from stereovox.view.scene.scale import Scale, scale_of
from stereovox.view.scene.viewpoint import known_viewpoint

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
