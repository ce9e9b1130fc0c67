# SPDX-License-Identifier: Apache-2.0
"""The log-odds of a layer as a landscape of columns: valleys are free, towers occupied (Chien 2020, Fig 4.6, below)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.maps import State, VoxelMap
from stereovox.products.floor.slices import Layer
from stereovox.view.figures import DPI
from stereovox.view.panels import STATE_COLOURS, round_length, title
from stereovox.view.scene.render import Direction, render
from stereovox.view.scene.scale import Scale, scale_of
from stereovox.view.scene.shading import Occlusion
from stereovox.view.scene.space import draw_frame, fit, numbers

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
