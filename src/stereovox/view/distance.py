# SPDX-License-Identifier: Apache-2.0
"""Picture of one layer of a distance field: the distance to the nearest obstacle in colours and contours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stereovox.errors import StereovoxError
from stereovox.products.distance import DistanceField
from stereovox.products.floor.floor_axes import floor_axes
from stereovox.view.figures import WIDTH, figure_of, save, title_above
from stereovox.view.scene.drawn import UPS, checked_up

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
