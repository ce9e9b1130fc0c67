# SPDX-License-Identifier: Apache-2.0
"""Map as a figure for a paper: as wide as a column, with small readable letters and no title."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import State, VoxelMap
from stereovox.products.floor_axes import Layer
from stereovox.view.drawn import Drawn, camera_path, checked_up, turned, upright
from stereovox.view.figures import INK, PATH_COLOUR, STATE_COLOURS, round_length
from stereovox.view.layer import shown_height, upright_layer
from stereovox.view.picture import TOP, height_colours
from stereovox.view.render import Direction, render
from stereovox.view.space import ABOVE_DEG, BEHIND_DEG

MM = 1 / 25.4
"""Inches."""
NARROWEST_MM, WIDEST_MM = 30.0, 400.0
DPI = 600
"""Dots per inch of cells drawn as an image; letters and lines stay vectors in .pdf and .svg."""
LETTERS_PT, LINE_PT, PATH_PT = 7.0, 0.5, 0.9
BAR_SHARE = 0.12
"""Width of the colour bar, as a share of the figure's."""
STYLE: dict[Any, Any] = {
    "font.size": LETTERS_PT,
    "axes.linewidth": LINE_PT,
    "xtick.major.width": LINE_PT,
    "ytick.major.width": LINE_PT,
    "xtick.major.size": 2.0,
    "ytick.major.size": 2.0,
    "axes.labelpad": 1.5,
    "xtick.major.pad": 1.5,
    "ytick.major.pad": 1.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
}


def draw_paper(
    voxel_map: VoxelMap,
    view: str,
    up: str,
    width_mm: float,
    at_m: float | None = None,
    viewpoint: Viewpoint | None = None,
) -> Any:
    """Return a figure `width_mm` wide: `overview` from above, `space` from the side, or the states of a `layer`.

    All show metres, on axes or a scale bar. The camera's path is drawn if the map has it. at_m, viewpoint: as in
    `draw_view`. Raises StereovoxError for another view, an invalid width, and an empty map.
    """
    from matplotlib import rc_context

    if view not in DRAWN:
        raise StereovoxError(f"--width-mm: goes with the views {', '.join(DRAWN)}; leave it out for '{view}'")
    if not NARROWEST_MM <= width_mm <= WIDEST_MM:
        raise StereovoxError(f"--width-mm {width_mm:g}: give {NARROWEST_MM:g} to {WIDEST_MM:g}")
    up = checked_up(up)
    with rc_context(STYLE):
        if view == "layer":
            height = shown_height(voxel_map, up, viewpoint or voxel_map.viewpoint) if at_m is None else at_m
            return _layer(voxel_map, upright_layer(voxel_map, up, height), width_mm)
        drawn = upright(voxel_map, camera_path(voxel_map), up)
        if not len(drawn.below_ceiling):
            raise StereovoxError("the map holds no occupied cell to draw; look at a layer instead (--view layer)")
        return DRAWN[view](drawn, width_mm)


def _from_above(drawn: Drawn, width_mm: float) -> Any:
    figure, axis = _cells(drawn, TOP, width_mm)
    axis.set_xlabel(f"{drawn.names[0]} [m]")
    axis.set_ylabel(f"{drawn.names[1]} [m]")
    return figure


def _from_the_side(drawn: Drawn, width_mm: float) -> Any:
    figure, axis = _cells(drawn, Direction.of(-90 + BEHIND_DEG, ABOVE_DEG), width_mm)
    axis.set_axis_off()
    _scale_bar(axis)
    return figure


DRAWN: dict[str, Callable[..., Any]] = {"overview": _from_above, "space": _from_the_side, "layer": _from_above}


def _cells(drawn: Drawn, direction: Direction, width_mm: float) -> tuple[Any, Any]:
    """Return figure and panel with the cells below a ceiling, the path, and a bar of the heights."""
    colours, mappable = height_colours(drawn)
    width_px = int(width_mm * MM * DPI * (1 - BAR_SHARE))
    rendering = render(drawn.below_ceiling, colours, drawn.voxel_size, direction, width_px, width_px, drawn.occlusion)
    left, right, bottom, top = rendering.extent
    figure, axis = _figure(width_mm, (top - bottom) / (right - left) * (1 - 2 * BAR_SHARE))
    axis.imshow(rendering.image, extent=rendering.extent, interpolation="antialiased")
    if drawn.path is not None and len(drawn.path):
        axis.plot(*direction.flat(drawn.path).T, color=PATH_COLOUR, linewidth=PATH_PT)
    bar = figure.colorbar(mappable, ax=axis, pad=0.02, fraction=0.035, aspect=25)
    bar.set_label(f"height {drawn.names[2]} [m]")
    bar.outline.set_linewidth(LINE_PT)
    return figure, axis


def _layer(voxel_map: VoxelMap, one: Layer, width_mm: float) -> Any:
    """Draw the states as rectangles, one per run of equal cells in a row: sharp at any size."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Patch

    rows, columns = one.state.shape
    figure, axis = _figure(width_mm, rows / columns)
    axis.set_facecolor(STATE_COLOURS[State.UNKNOWN])
    left, _, bottom, _ = one.extent
    size = voxel_map.voxel_size
    for state in (State.FREE, State.TENTATIVE, State.OCCUPIED):
        corners = runs(one.state == state) * size + [left, bottom]
        axis.add_collection(
            PolyCollection(list(corners), facecolor=STATE_COLOURS[state], edgecolor=STATE_COLOURS[state], linewidth=0.1)
        )
    path = turned(camera_path(voxel_map), one.across)
    if len(path):
        axis.plot(*path[:, :2].T, color=PATH_COLOUR, linewidth=PATH_PT)
    axis.set(xlim=one.extent[:2], ylim=one.extent[2:], aspect="equal")
    axis.set_xlabel(f"{one.axes[0]} [m]")
    axis.set_ylabel(f"{one.axes[1]} [m]")
    patches = [Patch(fc=STATE_COLOURS[state], ec="#888", lw=LINE_PT, label=state.name.lower()) for state in State]
    figure.legend(handles=patches, loc="outside upper center", ncols=4, frameon=False, handlelength=1.0,
                  handletextpad=0.4, columnspacing=1.0, borderpad=0.1)  # fmt: skip
    return figure


def runs(chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the corners (N, 4, 2) of rectangles that cover the chosen cells (rows, columns), in cells as x and y."""
    padded = np.pad(chosen, ((0, 0), (1, 1))).astype(np.int8)
    row, column = np.nonzero(np.diff(padded, axis=1))
    row, first, beyond = row[::2], column[::2], column[1::2]
    corners = [(first, row), (beyond, row), (beyond, row + 1), (first, row + 1)]
    return np.stack([np.stack(corner, axis=-1) for corner in corners], axis=1).astype(float)


def _figure(width_mm: float, shape: float) -> tuple[Any, Any]:
    """Return an empty figure with a panel `shape` times as high as wide, and the panel."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    width = width_mm * MM
    height = float(np.clip(width * shape + 0.35, 0.4 * width, 2.5 * width))
    figure = Figure((width, height), dpi=DPI, facecolor="white", layout=ConstrainedLayoutEngine(w_pad=0.01, h_pad=0.01))
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


def _scale_bar(axis: Any) -> None:
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    length = round_length((right - left) / 5)
    low = bottom - 0.03 * (top - bottom)
    axis.plot([left, left + length], [low, low], color=INK, linewidth=1.4, solid_capstyle="butt", clip_on=False)
    axis.annotate(f"{length:g} m", (left + length, low), (3, 0), textcoords="offset points", va="center")
    axis.set(xlim=(left, right), ylim=(bottom - 0.06 * (top - bottom), top))
