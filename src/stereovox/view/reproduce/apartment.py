# SPDX-License-Identifier: Apache-2.0
"""Pictures of an apartment's maps beside its true floor plan (Chien 2020, Fig 4.11)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.maps import VoxelMap
from stereovox.products.slices import layer
from stereovox.sources.scene import Solid
from stereovox.view.charts import labels
from stereovox.view.panels import GREY, INK, PATH_COLOUR, measured, title
from stereovox.view.reproduce.shared import OURS, SECOND, cut, figure_of, png


def apartment_png(
    maps: Sequence[tuple[str, VoxelMap]],
    solids: Sequence[Solid],
    way: NDArray[np.float64],
    reported: NDArray[np.float64],
) -> bytes:
    """Return the true floor plan, the tracker's errors, and a layer of each map with the true walls as lines.

    maps: name and map, in Chien's axes (y down). way, reported: (N, 3) true and reported positions.
    """
    at_m = float(way[0, 1])
    plan = [(solid.part, cut(solid, at_m)) for solid in solids]
    plan = [(part, polygon) for part, polygon in plan if len(polygon) > 2]
    figure = figure_of(6.4 * (1 + -(-len(maps) // 2)))
    spots = figure.add_gridspec(1 + -(-len(maps) // 2), 2)
    _floor_plan(figure.add_subplot(spots[0, 0]), plan, way)
    _drift(figure.add_subplot(spots[0, 1]), way, reported)
    corners = np.concatenate([polygon for _, polygon in plan])
    limits = np.stack([corners.min(0) - 0.4, corners.max(0) + 0.4])
    for n, (name, voxel_map) in enumerate(maps):
        axis = figure.add_subplot(spots[1 + n // 2, n % 2])
        mappable = _layer(axis, voxel_map, at_m)
        for part, polygon in plan:
            if part == "walls":
                axis.fill(*polygon.T, fill=False, edgecolor=SECOND, linewidth=0.7)
        axis.set(xlim=limits[:, 0], ylim=limits[:, 1])
        title(axis, f"{name}, cells of {voxel_map.voxel_size:g} m")
        _colour_bar(figure, axis, mappable, voxel_map)
    return png(figure)


def _floor_plan(axis: Any, plan: Sequence[tuple[str, NDArray[np.float64]]], way: NDArray[np.float64]) -> None:
    for part, polygon in plan:
        axis.fill(*polygon.T, color=INK if part == "walls" else "#cdb48c")
    axis.plot(way[:, 0], way[:, 2], color=PATH_COLOUR, linewidth=1)
    axis.set_aspect("equal")
    title(axis, "True floor plan at the camera's height, and the way")
    measured(axis, ("x", "z", "y"))


def _drift(axis: Any, way: NDArray[np.float64], reported: NDArray[np.float64]) -> None:
    walked = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    axis.plot(walked, 100 * np.linalg.norm(reported - way, axis=1), color=OURS)
    axis.set(ylim=(0, None), xlim=(0, walked[-1]))
    title(axis, "How far the simulated T265 is off")
    labels(axis, "way [m]", "error of its position [cm]")


def _layer(axis: Any, voxel_map: VoxelMap, at_m: float) -> Any:
    one = layer(voxel_map, "y", at_m)
    limits = voxel_map.config.map
    values = np.clip(one.log_odds, limits.log_odds_min, limits.log_odds_max)
    axis.set_facecolor("#e6e8ec")
    drawn = axis.imshow(values, origin="lower", extent=one.extent, cmap="viridis", vmin=limits.log_odds_min,
                        vmax=limits.log_odds_max, interpolation="nearest")  # fmt: skip
    measured(axis, ("x", "z", "y"))
    return drawn


def _colour_bar(figure: Any, axis: Any, mappable: Any, voxel_map: VoxelMap) -> None:
    bar = figure.colorbar(mappable, ax=axis, pad=0.01, fraction=0.03, aspect=25)
    bar.outline.set_visible(False)
    if voxel_map.cell_format.unknown:
        stored = np.array([0, 64, 127, 180, 255], np.uint8)
        bar.set_ticks(voxel_map.cell_format.log_odds(stored).tolist(), labels=stored.astype(str).tolist())
        bar.set_label("cell value", color=GREY)
    else:
        bar.set_label("log-odds", color=GREY)
