# SPDX-License-Identifier: Apache-2.0
"""Pictures of IST 2019: what synthetic beams mark (Fig 3), and maps of floors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stereovox.evaluate.reproduce.ist.fans import Fan
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.view.grid import draw_grid, plan
from stereovox.view.panels import title
from stereovox.view.reproduce.shared import figure_of, png

MAP_DPI = 75


def fans_png(fans: Sequence[Fan]) -> bytes:
    """Return the maps that synthetic beams made, side by side, with counted cells (after Fig 3)."""
    figure = figure_of(8.0)
    for axis, fan in zip(figure.subplots(1, len(fans), squeeze=False)[0], fans, strict=True):
        _fan(axis, fan)
    return png(figure)


def floor_png(grid: OccupancyGrid, heading: str, track: ArrayLike | None = None) -> bytes:
    """Return a floor's map with the robot's way."""
    return png(draw_grid(grid, heading, track), MAP_DPI)


def _fan(axis: Any, fan: Fan) -> None:
    plan(axis, fan.grid)
    reach = float(fan.scan.ranges.max())
    axis.set(xlim=(-0.3, reach + 0.5), ylim=(-0.56 * reach, 0.56 * reach))
    axis.plot(0, 0, "^", color="#d1603d", markersize=9)
    ends = fan.scan.ranges[:, None] * np.column_stack([np.cos(fan.scan.angles), np.sin(fan.scan.angles)])
    if len(ends) < 50:
        axis.plot(*ends.T, ".", color="#d1603d", markersize=4)
    title(axis, f"{len(ends)} beams: {fan.free:,} cells free, {fan.occupied:,} occupied")
