# SPDX-License-Identifier: Apache-2.0
"""A flight with its window, trigger box and tiles (Chien 2020, Fig 3.14 to 3.16)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.reproduce.shifting import Flight
from stereovox.view.charts import labels
from stereovox.view.panels import INK, PATH_COLOUR, title
from stereovox.view.reproduce.shared import OURS, SECOND, THESIS, figure_of, png

NEAR_M = 0.5
"""Cells up to so far above and below the first camera are drawn: without floor and ceiling."""


def flight_png(flight: Flight) -> bytes:
    """Return the flight from above with windows and tiles (after Fig 3.14 to 3.16), and what moves cost."""
    figure = figure_of(7.0)
    left, right = figure.subplots(1, 2, width_ratios=[2.4, 1])
    _flight_plan(left, flight)
    right.hist(1e3 * flight.shift_ms, np.linspace(0, 1e3 * np.percentile(flight.shift_ms, 97), 40).tolist(), color=OURS)
    title(right, f"{len(flight.shift_ms)} moves of the window")
    labels(right, "time of one move [microseconds]", "moves")
    return png(figure)


def _flight_plan(axis: Any, flight: Flight) -> None:
    occupied = flight.voxel_map.occupied()
    occupied = occupied[np.abs(occupied[:, 1] - flight.way[0, 1]) < NEAR_M]
    cells = np.unique(np.floor(occupied[:, [0, 2]] / flight.voxel_map.voxel_size), axis=0) + 0.5
    x, z = cells.T * flight.voxel_map.voxel_size
    axis.plot(z, x, "s", color=INK, markersize=1.1)
    for low, high in flight.tiles:
        axis.fill(*_rectangle(low, high), fill=False, edgecolor=THESIS, linewidth=0.8)
    shown = np.linspace(0, len(flight.windows) - 1, 4).astype(int)
    for n, k in enumerate(shown):
        low, high = flight.windows[k]
        middle, trigger = (low + high) / 2, flight.voxel_map.config.window.trigger
        colour = OURS if n < len(shown) - 1 else SECOND
        axis.fill(*_rectangle(low, high), fill=False, edgecolor=colour, linewidth=1.6)
        axis.fill(*_rectangle(middle - trigger, middle + trigger), fill=False, edgecolor=PATH_COLOUR, linewidth=1.4)
    axis.plot(flight.way[:, 2], flight.way[:, 0], color=PATH_COLOUR, linewidth=1)
    axis.set_aspect("equal")
    title(axis, "Occupied cells near the flight's height, way, windows, trigger boxes, tiles")
    labels(axis, "z, ahead [m]", "x, to the right [m]")


def _rectangle(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[list[float], list[float]]:
    return [low[2], high[2], high[2], low[2]], [low[0], low[0], high[0], high[0]]
