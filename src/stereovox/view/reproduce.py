# SPDX-License-Identifier: Apache-2.0
"""Pictures for `stereovox reproduce`: ours beside what a thesis shows. All return PNG as bytes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.reproduce.aisle import FAR_M, AisleFound
from stereovox.evaluate.reproduce.boxes import DIRECTIONS, BoxFound
from stereovox.evaluate.reproduce.shifting import Flight
from stereovox.evaluate.reproduce.timing import Timed
from stereovox.evaluate.reproduce.tracers import Comparison
from stereovox.maps import VoxelMap
from stereovox.products.slices import layer
from stereovox.sources.scene import Solid
from stereovox.view.axis import draw_profile
from stereovox.view.layer import draw_landscape, draw_plan
from stereovox.view.panels import GREY, INK, LINE, PATH_COLOUR, STATE_COLOURS, measured, title
from stereovox.view.picture import draw
from stereovox.view.space import draw_space

DPI = 90
WIDTH = 14.0
"""Inches."""
THESIS, OURS, SECOND = "#b9c0cb", "#23618c", "#d1603d"


def box_png(line: BoxFound, ray: BoxFound) -> bytes:
    """Return the layer at the camera's height by both tracers, the optical axis and the landscape (after Fig 4.6)."""
    figure = _figure(11.0)
    top, low = figure.add_gridspec(2, 1, height_ratios=[1, 1])
    upper, lower = top.subgridspec(1, 2), low.subgridspec(1, 2, width_ratios=[1.1, 1])
    for spot, found, name in ((upper[0], line, "Line drawing"), (upper[1], ray, "Voxel traversal")):
        axis = figure.add_subplot(spot)
        draw_plan(axis, layer(found.voxel_map, "y", 0.0), found.voxel_map.viewpoint)
        _true_box(axis, found)
        axis.set(xlim=(-2.4, 2.4), ylim=(-0.2, 4.6))
        title(axis, f"{name}, layer below the camera's height")
    draw_profile(figure.add_subplot(lower[0]), line.voxel_map, 5.0)
    draw_landscape(figure.add_subplot(lower[1], projection="3d"), layer(line.voxel_map, "y", 0.0), line.voxel_map)
    return _png(figure)


def space_png(voxel_map: VoxelMap, heading: str) -> bytes:
    """Return a map's cells in space with the field of view (after Fig 4.7)."""
    return _png(draw_space(voxel_map, heading, voxel_map.config.up), 70)


def overview_png(voxel_map: VoxelMap, way: NDArray[np.float64], heading: str) -> bytes:
    """Return a map from above, from three sides and cut open, with the camera's way (N, 3)."""
    return _png(draw(voxel_map, heading=heading, trajectory=way, up=voxel_map.config.up), 70)


def placements_png(found: Sequence[BoxFound]) -> bytes:
    """Return how far off each side of the boxes stands, in cells, for both tracers."""
    figure = _figure(3.6)
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
        title(axis, f"`{name}`, {len(errors)} boxes")
        _labels(axis, "share of boxes [%]", "side of the box")
    return _png(figure)


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
    figure = _figure(5.0 * (1 + -(-len(maps) // 2)))
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
    return _png(figure)


def aisle_png(found: Sequence[AisleFound], solids: Sequence[Solid]) -> bytes:
    """Return the layer at the camera's height of every variant, the aisle lying on its side (after Fig 4.12)."""
    figure = _figure(1.45 * len(found) + 0.4)
    for axis, one in zip(figure.subplots(len(found), 1, sharex=True), found, strict=True):
        cut_open = layer(one.voxel_map, "y", 0.0)
        axis.imshow(_state_image(cut_open.state.T), origin="lower", interpolation="nearest",
                    extent=(*cut_open.extent[2:], *cut_open.extent[:2]))  # fmt: skip
        for solid in solids:
            polygon = cut(solid, 0.0)
            if len(polygon) > 2:
                axis.fill(*polygon[:, ::-1].T, fill=False, edgecolor=SECOND, linewidth=0.9)
        axis.axvline(FAR_M, color=GREY, linewidth=1, linestyle=":")
        axis.set(xlim=(-0.3, 13.0), ylim=(-1.0, 1.0))
        title(axis, f"{one.variant.name}: {100 * one.found:.0f} % of the far walls' cells")
        _labels(axis, "", "x [m]")
    axis.set_xlabel("distance [m]; right of the dotted line is far", color=GREY)
    return _png(figure)


def times_png(rows: Sequence[Timed]) -> bytes:
    """Return the milliseconds of a whole frame as bars, the thesis's beside ours."""
    figure = _figure(0.5 * len(rows) + 1.0)
    axis = figure.add_subplot()
    place = np.arange(len(rows))
    known = [(p, row.row.thesis_ms) for p, row in zip(place, rows, strict=True) if row.row.thesis_ms]
    axis.barh([p - 0.2 for p, _ in known], [ms for _, ms in known], 0.38, color=THESIS, label="thesis, i7-8550U")
    axis.barh(place + 0.2, [row.mean_ms for row in rows], 0.38, color=OURS, label="ours, this machine, one thread")
    axis.set(xscale="log", yticks=place, yticklabels=[row.row.name for row in rows])
    axis.invert_yaxis()
    axis.legend(frameon=False, loc="lower right")
    _labels(axis, "milliseconds a frame, mean (logarithmic)", "")
    return _png(figure)


def tracers_png(found: Comparison, size: float) -> bytes:
    """Return which cells of one frame, in the layer at the camera's height, are updated by both tracers or one."""
    from matplotlib.patches import Patch

    from stereovox.evaluate.cells import indices

    figure = _figure(6.5)
    axis = figure.add_subplot()
    height = int(np.floor(found.eye[1] / size))
    layers = {name: indices(cells)[indices(cells)[:, 1] == height][:, [0, 2]] for name, cells in found.updated.items()}
    low = np.min([cells.min(0) for cells in layers.values()], axis=0)
    shape = np.max([cells.max(0) for cells in layers.values()], axis=0) - low + 1
    image = np.zeros(shape, int)
    for bit, cells in zip((1, 2), layers.values(), strict=True):
        image[tuple((cells - low).T)] |= bit
    colours = np.array([[255, 255, 255], [209, 96, 61], [35, 97, 140], [216, 221, 229]], np.uint8)
    extent = np.stack([low, low + shape]).T.ravel() * size
    axis.imshow(colours[image.T], origin="lower", extent=tuple(extent), interpolation="nearest")
    names = ("both", "only voxel traversal", "only line drawing")
    patches = [Patch(fc=colours[n] / 255, ec="#888", label=name) for n, name in zip((3, 1, 2), names, strict=True)]
    axis.legend(handles=patches, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    title(axis, "Cells that one frame updates, layer at the camera's height, 8x8")
    measured(axis, ("x", "z", "y"))
    return _png(figure)


def flight_png(flight: Flight) -> bytes:
    """Return the flight from above with windows and tiles (after Fig 3.14 to 3.16), and what moves cost."""
    figure = _figure(7.0)
    left, right = figure.subplots(1, 2, width_ratios=[2.4, 1])
    _flight_plan(left, flight)
    right.hist(1e3 * flight.shift_ms, np.linspace(0, 1e3 * np.percentile(flight.shift_ms, 97), 40).tolist(), color=OURS)
    title(right, f"{len(flight.shift_ms)} moves of the window")
    _labels(right, "time of one move [microseconds]", "moves")
    return _png(figure)


def cut(solid: Solid, y: float) -> NDArray[np.float64]:
    """Return the corners (N, 2) in x and z of a convex solid's section at this height, in order; empty where none."""
    edges = np.concatenate([solid.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    a, b = edges[:, 0], edges[:, 1]
    crosses = (a[:, 1] < y) != (b[:, 1] < y)
    if not crosses.any():
        return np.zeros((0, 2))
    a, b = a[crosses], b[crosses]
    points = (a + (b - a) * ((y - a[:, 1]) / (b[:, 1] - a[:, 1]))[:, None])[:, [0, 2]]
    around = points - points.mean(0)
    return points[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]


def _true_box(axis: Any, found: BoxFound) -> None:
    (x0, _, z0), (x1, _, z1) = found.placement.bounds
    axis.fill([x0, x1, x1, x0], [z0, z0, z1, z1], fill=False, edgecolor=PATH_COLOUR, linewidth=2)


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
    _labels(axis, "way [m]", "error of its position [cm]")


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


def _state_image(states: NDArray[np.uint8]) -> NDArray[np.uint8]:
    colours = [[int(STATE_COLOURS[state][i : i + 2], 16) for i in (1, 3, 5)] for state in sorted(STATE_COLOURS)]
    return np.array(colours, np.uint8)[states]


def _flight_plan(axis: Any, flight: Flight) -> None:
    occupied = flight.voxel_map.occupied()
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
    title(axis, "Occupied cells, way, four windows with trigger boxes, tiles on disk (grey)")
    _labels(axis, "z, ahead [m]", "x, to the right [m]")


def _rectangle(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[list[float], list[float]]:
    return [low[2], high[2], high[2], low[2]], [low[0], low[0], high[0], high[0]]


def _labels(axis: Any, x: str, y: str) -> None:
    axis.set_xlabel(x, color=GREY)
    axis.set_ylabel(y, color=GREY)
    axis.tick_params(colors=GREY, labelsize=9)
    for spine in axis.spines.values():
        spine.set_color(LINE)


def _figure(height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure((WIDTH, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(made)
    return made


def _png(figure: Any, dpi: int = DPI) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, dpi=dpi, format="png")
    return out.getvalue()
