# SPDX-License-Identifier: Apache-2.0
"""Overview of a map on one page: from above, from three sides, and a slice at one height."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.maps import VoxelMap
from stereovox.view.drawn import Drawn, camera_path, upright
from stereovox.view.figures import (
    DPI,
    GREY,
    WIDTH,
    figure_of,
    headline,
    keep_clear,
    measured,
    oblique,
    save,
    slice_,
    title,
    view,
)
from stereovox.view.render import Direction, extent

LONG = 1.8
"""A map this many times longer than wide runs across the whole page."""
HEIGHT_COLOURS = "viridis"
DARKEST, PALE = 0.1, 0.24
"""Share of these colours left out at the dark end, and of white mixed in: shading and dark pages need the room."""
TOP = Direction.of(-90, 90)


def picture(
    voxel_map: VoxelMap,
    path: str | Path,
    *,
    title: str | None = None,
    trajectory: ArrayLike | None = None,
    up: str = "z",
) -> None:
    """Write a PNG of a map: top view, three oblique views coloured by height, and a slice with all four states.

    trajectory: camera positions (N, 3) in metres, drawn as a line; by default the path stored in the map, and none
    if it is empty. up: the map's axis that points up (`z`, `-y`, ...). A ceiling is hidden. An empty map gives a
    picture that says so. Raises StereovoxError for an invalid `up`, a name that does not end in .png or a file that
    cannot be written.
    """
    save(draw(voxel_map, heading=title or "Occupancy map", trajectory=trajectory, up=up), path)


def draw(
    voxel_map: VoxelMap,
    *,
    heading: str,
    trajectory: ArrayLike | None = None,
    up: str = "z",
    counted: VoxelMap | None = None,
) -> Any:
    """Return the matplotlib figure that `picture` saves; `counted`: the map whose numbers it states, if another."""
    counted, voxel_map = counted or voxel_map, voxel_map.overview()
    drawn = upright(voxel_map, camera_path(voxel_map) if trajectory is None else trajectory, up)
    if not len(drawn.cells):
        figure = _note("This map is empty: no cell is known yet.")
    elif not len(drawn.below_ceiling):
        figure = _only_slice(drawn)
    else:
        figure = _page(drawn)
    headline(figure, counted, heading, _about_path(drawn))
    return figure


def _about_path(drawn: Drawn) -> list[str]:
    """Return a fact for the headline: meaning and length of the line."""
    if drawn.path is None or not np.isfinite(drawn.path).any():
        return []
    length = np.nansum(np.linalg.norm(np.diff(drawn.path, axis=0), axis=1))
    return [f"red: the camera's path, {length:.1f} m, from dot to square"]


def _note(text: str) -> Any:
    figure = figure_of(4)
    figure.text(0.5, 0.4, text, ha="center", fontsize=20, color=GREY)
    return figure


def _only_slice(drawn: Drawn) -> Any:
    figure = figure_of(9)
    axis = figure.add_subplot()
    slice_(axis, drawn)
    keep_clear(axis)
    figure.text(0.5, 0.01, "No cell is occupied.", ha="center", fontsize=14, color=GREY)
    return figure


def _page(drawn: Drawn) -> Any:
    solid = drawn.below_ceiling
    if drawn.path is not None:  # the panels must contain it too
        there = drawn.path[np.isfinite(drawn.path).all(axis=1)]
        solid = np.concatenate([solid, np.floor(there / drawn.voxel_size).astype(np.int32)])
    across, away = np.ptp(extent(solid, 1.0, TOP), axis=0)
    lay_out = _long_page if across > LONG * away else _square_page
    figure, spots, directions = lay_out(solid, away / across)
    axes = [figure.add_subplot(spot) for spot, _ in spots]
    colours, mappable = height_colours(drawn)
    view(axes[0], drawn, colours, TOP, int(spots[0][1] * DPI))
    cut = "" if drawn.cut is None else f", cut open at {drawn.names[2]} = {drawn.cut:.2f} m"
    title(axes[0], f"From above{cut}")
    measured(axes[0], drawn.names)
    for axis, (_, width), direction, name in zip(axes[1:4], spots[1:4], directions, "ABC", strict=True):
        oblique(axis, drawn, colours, direction, int(width * DPI))
        title(axis, f"View {name}")
    slice_(axes[4], drawn)
    height_bar(figure, axes[0], mappable, drawn)
    keep_clear(axes[4])
    return figure


def height_bar(figure: Any, axis: Any, mappable: Any, drawn: Drawn) -> None:
    """Add the colour bar of heights next to a panel."""
    bar = figure.colorbar(mappable, ax=axis, pad=0.01, fraction=0.03, aspect=25)
    bar.set_label(f"height {drawn.names[2]} [m]", color=GREY)
    bar.ax.tick_params(colors=GREY)
    bar.outline.set_visible(False)


def _long_page(solid: NDArray[np.int32], shape: float) -> tuple[Any, list[Any], list[Direction]]:
    """Return figure, five (place, width in inches) and three directions for a map that is long in x."""
    directions = [Direction.of(*angles) for angles in ((-62, 48), (196, 42), (24, 42))]
    wide, narrow = WIDTH * 0.66, WIDTH * 0.31
    top = 14.2 * shape + 0.8
    middle = _row_height(solid, [(wide, directions[0]), (narrow, directions[1])])
    low = max(_row_height(solid, [(narrow, directions[2])]), wide * shape + 0.8)
    figure = figure_of(top + middle + low + 1.0)
    rows = figure.add_gridspec(3, 1, height_ratios=[top, middle, low])
    upper, lower = rows[1].subgridspec(1, 3), rows[2].subgridspec(1, 3)
    spots = [(rows[0], 14.2), (upper[:2], wide), (upper[2], narrow), (lower[0], narrow), (lower[1:], wide)]
    return figure, spots, directions


def _square_page(solid: NDArray[np.int32], shape: float) -> tuple[Any, list[Any], list[Direction]]:
    directions = [Direction.of(*angles) for angles in ((-60, 45), (210, 40), (45, 42))]
    half, third = WIDTH * 0.45, WIDTH * 0.32
    top = min(half * shape, 9.0) + 0.8
    low = _row_height(solid, [(third, direction) for direction in directions])
    figure = figure_of(top + low + 1.0)
    rows = figure.add_gridspec(2, 1, height_ratios=[top, low])
    upper, lower = rows[0].subgridspec(1, 2), rows[1].subgridspec(1, 3)
    spots = [(upper[0], half), *((lower[n], third) for n in range(3)), (upper[1], half)]
    return figure, spots, directions


def _row_height(solid: NDArray[np.int32], panels: list[tuple[float, Direction]]) -> float:
    """Return the height in inches of a row of panels of these widths, limited to a reasonable range."""
    needed = [width * np.divide(*np.ptp(extent(solid, 1.0, direction), axis=0)[::-1]) for width, direction in panels]
    return float(np.clip(1.1 * max(needed) + 0.4, 3.0, 6.0))


def height_colours(drawn: Drawn) -> tuple[NDArray[np.float64], Any]:
    """Return the colour (N, 3) of every drawn cell, pale enough for shading, and the mappable of a colour bar."""
    height = (drawn.below_ceiling[:, 2] + 0.5) * drawn.voxel_size
    mappable = height_scale(height, drawn.voxel_size)
    return mappable.to_rgba(height)[:, :3], mappable


def height_scale(height: NDArray[np.floating], voxel_size: float) -> Any:
    """Return matplotlib's colours for heights (N,) in metres of cells' middles, a few outliers left out."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    low, high = np.percentile(height, [0.5, 99.5]) if len(height) else (0.0, 0.0)
    table = colormaps[HEIGHT_COLOURS](np.linspace(DARKEST, 1, 256))[:, :3] * (1 - PALE) + PALE
    return ScalarMappable(Normalize(low - voxel_size / 2, high + voxel_size / 2), ListedColormap(table))
