# SPDX-License-Identifier: Apache-2.0
"""Pictures of boxes in a map: what Chien 2020 shows in Fig 4.6, 4.7, 4.9 and 4.10, and errors of many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stereovox.evaluate.reproduce.boxes import DIRECTIONS, BoxFound
from stereovox.maps import VoxelMap
from stereovox.products.slices import layer
from stereovox.view.axis import draw_profile
from stereovox.view.charts import labels
from stereovox.view.landscape import draw_landscape
from stereovox.view.layer import draw_plan
from stereovox.view.panels import INK, PATH_COLOUR, title
from stereovox.view.reproduce.shared import figure_of, png
from stereovox.view.space import draw_space

NAMES = {"line": "Line drawing", "ray": "Voxel traversal"}


def box_png(line: BoxFound, ray: BoxFound) -> bytes:
    """Return the layer at the camera's height by both tracers, the optical axis and the landscape (after Fig 4.6)."""
    figure = figure_of(11.0)
    top, low = figure.add_gridspec(2, 1, height_ratios=[1, 1])
    upper, lower = top.subgridspec(1, 2), low.subgridspec(1, 2, width_ratios=[1.1, 1])
    for spot, found, name in ((upper[0], line, NAMES["line"]), (upper[1], ray, NAMES["ray"])):
        axis = figure.add_subplot(spot)
        draw_plan(axis, layer(found.voxel_map, "y", 0.0), found.voxel_map.viewpoint)
        _true_box(axis, found)
        axis.set(xlim=(-2.6, 2.6), ylim=(-0.2, 4.6))
        title(axis, name)
    draw_profile(figure.add_subplot(lower[0]), line.voxel_map, 5.0)
    draw_landscape(figure.add_subplot(lower[1]), layer(line.voxel_map, "y", 0.0), line.voxel_map)
    return png(figure)


def space_png(voxel_map: VoxelMap, heading: str) -> bytes:
    """Return a map's cells in space with the field of view (after Fig 4.7)."""
    return png(draw_space(voxel_map, heading, voxel_map.config.up), 70)


def placements_png(found: Sequence[BoxFound]) -> bytes:
    """Return how far off each side of the boxes stands, in cells, for both tracers."""
    figure = figure_of(3.6)
    names = list(dict.fromkeys(one.integrator for one in found))
    for axis, name in zip(figure.subplots(1, len(names), sharey=True, squeeze=False)[0], names, strict=True):
        errors = np.array([one.errors for one in found if one.integrator == name and one.errors is not None])
        for value, colour in ((-1, "#9fb6d8"), (0, INK), (1, "#e8a33d")):
            share = 100 * (errors == value).mean(axis=0)
            left = 100 * ((errors < value) & (errors >= -1)).mean(axis=0)
            axis.barh(DIRECTIONS, share, left=left, color=colour, label=f"{value:+d}" if value else "0")
        axis.set(xlim=(0, 100))
        axis.invert_yaxis()
        axis.legend(
            title="cells outwards", frameon=False, ncols=3, loc="lower right", bbox_to_anchor=(1, 1), fontsize=9
        )
        title(axis, f"{NAMES[name]}, {len(errors)} boxes")
        labels(axis, "share of boxes [%]", "side of the box")
    return png(figure)


def _true_box(axis: Any, found: BoxFound) -> None:
    (x0, _, z0), (x1, _, z1) = found.placement.bounds
    axis.fill([x0, x1, x1, x0], [z0, z0, z1, z1], fill=False, edgecolor=PATH_COLOUR, linewidth=2)
