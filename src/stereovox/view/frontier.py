# SPDX-License-Identifier: Apache-2.0
"""A picture of the frontiers of a map, from above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stereovox.maps import VoxelMap
from stereovox.products.frontiers import Frontier
from stereovox.products.ground_surfaces import floor_of
from stereovox.view.columns import draw_columns, finish, mark, page_of
from stereovox.view.figures import words_above
from stereovox.view.panels import INK

COLOURS = ("#e0452f", "#2f7fd1", "#3a9a4b", "#c77d0a", "#8448a8", "#0f9aa0", "#c2408c", "#7a5a32")
LABELLED = 12
"""The largest frontiers, which get a number and their place to look from."""


def draw_frontiers(voxel_map: VoxelMap, frontiers: Sequence[Frontier], heading: str) -> Any:
    """Return the matplotlib figure of the frontiers of a map, the largest on top."""
    floor = floor_of(voxel_map)
    figure, (axis,) = page_of(floor)
    draw_columns(axis, floor)
    for n in reversed(range(len(frontiers))):
        mark(axis, floor, voxel_map.centers(frontiers[n].cells), COLOURS[n % len(COLOURS)])
    for n, frontier in enumerate(frontiers[:LABELLED]):
        _label(axis, frontier, n + 1, list(floor.axes[:2]))
    finish(axis)
    seen = sum(frontier.look_from is not None for frontier in frontiers)
    words_above(figure, heading, [
        f"cells of {voxel_map.voxel_size:g} m", f"{len(frontiers)} frontiers, {seen} within reach",
        "dot: where to look at one from, the number: at its centroid",
    ])  # fmt: skip
    return figure


def _label(axis: Any, frontier: Frontier, number: int, axes: list[int]) -> None:
    x, y = frontier.centroid[axes]
    if frontier.look_from is not None:
        away = frontier.look_from[axes]
        axis.plot(*np.array([away, (x, y)]).T, color=INK, linewidth=1)
        axis.plot(*away, "o", color=INK, markeredgecolor="white", markersize=7)
    axis.text(
        x, y, str(number), ha="center", va="center", fontsize=11, weight="bold", color="white",
        bbox={"boxstyle": "circle,pad=0.2", "facecolor": COLOURS[(number - 1) % len(COLOURS)], "edgecolor": "white"},
    )  # fmt: skip
