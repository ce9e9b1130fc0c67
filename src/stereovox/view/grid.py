# SPDX-License-Identifier: Apache-2.0
"""Picture of a floor map: free, occupied and unknown cells, metres at the edges, and a robot's trajectory.

Differences of two 2-D maps: the binary image of IST 2019, Fig 6 and 9, and one with the kinds of difference.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.evaluate.grid_align import AlignedGrids, three_states
from stereovox.evaluate.grid_scores import Difference, differences, wrong
from stereovox.geometry import se2
from stereovox.maps import State
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.view.figures import (
    GREY,
    INK,
    PATH_COLOUR,
    STATE_COLOURS,
    WIDTH,
    blank,
    figure_of,
    measured,
    png_of,
    save,
    scale_bar,
    title,
    title_above,
)

MAX_PIXELS = 1500
"""Largest number of cells along the longer side that are drawn one per pixel; beyond, cells are pooled."""
Box = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lowest and highest (2,) x, y in metres."""
NAMES = {State.UNKNOWN: "unknown", State.FREE: "free", State.TENTATIVE: "tentative", State.OCCUPIED: "occupied"}


def picture_grid(
    grid: OccupancyGrid, path: str | Path, *, title: str | None = None, track: ArrayLike | None = None
) -> None:
    """Write a PNG of a floor map.

    track: (N, 2) or (N, 3) positions x, y (and yaw) of a robot in the map's frame, drawn as a line. A map without
    known cells gives a picture that says so. Raises StereovoxError for a name that does not end in .png or a file that
    cannot be written.
    """
    save(draw_grid(grid, title or "Floor map", track), path)


def draw_grid(grid: OccupancyGrid, heading: str, track: ArrayLike | None = None) -> Any:
    """Return the matplotlib figure that `picture_grid` saves."""
    box = bounds(grid, track)
    if box is None:
        figure = figure_of(4)
        figure.text(0.5, 0.4, "This map is empty: no cell is known yet.", ha="center", fontsize=20, color=GREY)
    else:
        (x0, y0), (x1, y1) = box
        figure = figure_of(float(np.clip(0.92 * WIDTH * (y1 - y0) / (x1 - x0), 3, 15)) + 1.6)
        axis = figure.add_subplot()
        plan(axis, trimmed(grid), track)
        framed(axis, box)
        legend(figure, grid.states, track is not None)
    title_above(figure, heading, facts(grid))
    return figure


def framed(axis: Any, box: Box) -> None:
    """Show a rectangle of a panel in metres, with a scale bar in a strip below it."""
    (x0, y0), (x1, y1) = box
    axis.set(xlim=(x0, x1), ylim=(y0 - 0.06 * (y1 - y0), y1))
    scale_bar(axis)
    axis.set_xlim(x0, x1 + 0.01 * (x1 - x0))


def facts(grid: OccupancyGrid) -> list[str]:
    """Describe the contents of a map."""
    rows, columns = grid.cells.shape
    counts = np.bincount(grid.states.ravel(), minlength=len(State))
    size = f"{columns * grid.resolution:.1f} x {rows * grid.resolution:.1f} m"
    return [f"cells of {grid.resolution:g} m", size, *(f"{counts[state]:,} {NAMES[state]}" for state in
            (State.OCCUPIED, State.FREE, State.TENTATIVE) if counts[state] or state != State.TENTATIVE)]  # fmt: skip


def bounds(grid: OccupancyGrid, track: ArrayLike | None = None) -> Box | None:
    """Return lowest and highest (2,) x, y of known cells and track, with a margin; None if missing."""
    corners = se2.transform(grid.origin, grid.known_corners * grid.resolution)
    if track is not None and np.size(track):
        corners = np.concatenate([corners, np.asarray(track, float)[:, :2]])
    if not len(corners):
        return None
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.02 * float((high - low).max()) + grid.resolution
    return low - margin, high + margin


def plan(axis: Any, grid: OccupancyGrid, track: ArrayLike | None = None, max_px: int = MAX_PIXELS) -> None:
    """Draw the states of a map's cells into a panel in metres of the map's frame, and a robot's track if given."""
    paint(axis, grid, grid.states, {int(state): STATE_COLOURS[state] for state in State}, max_px)
    axis.set_facecolor(STATE_COLOURS[State.UNKNOWN])
    if track is not None and np.size(track):
        x, y = np.asarray(track, float)[:, :2].T
        axis.plot(x, y, color=PATH_COLOUR, linewidth=1.6, solid_capstyle="round")
        axis.plot(x[:1], y[:1], "o", color=PATH_COLOUR, markeredgecolor="white", markersize=7)
        axis.plot(x[-1:], y[-1:], "s", color=PATH_COLOUR, markeredgecolor="white", markersize=7)


def paint(
    axis: Any, grid: OccupancyGrid, classes: NDArray[np.uint8], colours: Mapping[int, str], max_px: int = MAX_PIXELS
) -> None:
    """Draw classes (rows, columns) uint8 of the cells of `grid` into a panel.

    colours: of each class; if one pixel covers several cells the last class in this order is shown, so that a
    wall one cell wide is not lost. max_px: pixels along the longer side.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.transforms import Affine2D

    x, y, yaw = grid.origin
    step = -(-max(classes.shape) // max_px)
    ranks = pooled(classes, list(colours), step)
    rows, columns = (n * step * grid.resolution for n in ranks.shape)
    axis.imshow(
        ranks,
        cmap=ListedColormap(list(colours.values())),
        vmin=0,
        vmax=len(colours) - 1,
        origin="lower",
        extent=(0, columns, 0, rows),
        interpolation="nearest",
        transform=Affine2D().rotate(yaw).translate(x, y) + axis.transData,
    )
    axis.set_aspect("equal")
    measured(axis, ("x", "y", "z"))


def pooled(classes: NDArray[np.uint8], rising: Sequence[int], step: int) -> NDArray[np.uint8]:
    """Return, for each square of `step` by `step` cells, the index in `rising` of its last class in that order."""
    rank = np.zeros(256, np.uint8)
    rank[np.asarray(rising, int)] = np.arange(len(rising))
    rows, columns = (-(-n // step) * step for n in classes.shape)
    ranks = np.zeros((rows, columns), np.uint8)
    ranks[: classes.shape[0], : classes.shape[1]] = rank[classes]
    return ranks.reshape(rows // step, step, columns // step, step).max(axis=(1, 3))


def trimmed(grid: OccupancyGrid) -> OccupancyGrid:
    """Return a map without the unknown rows and columns at its rim."""
    rows, columns = grid.known_span
    x, y, yaw = se2.compose(grid.origin, [columns.start * grid.resolution, rows.start * grid.resolution, 0]).tolist()
    return replace(grid, cells=grid.cells[rows, columns], origin=(x, y, yaw))


def known_bounds(grid: OccupancyGrid) -> NDArray[np.float64] | None:
    """Return lowest and highest (2, 2) x, y in metres of the known cells, in the map's frame; None without any."""
    corners = se2.transform(grid.origin, grid.known_corners * grid.resolution)
    return np.stack([corners.min(axis=0), corners.max(axis=0)]) if len(corners) else None


def legend(figure: Any, shown: NDArray[np.uint8], with_track: bool) -> None:
    """Add the legend of `plan` below a figure, for the states that are `shown`."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    states = [State.OCCUPIED, State.FREE, State.UNKNOWN]
    if (shown == State.TENTATIVE).any():
        states.insert(1, State.TENTATIVE)
    handles: list[Any] = [Patch(fc=STATE_COLOURS[state], ec="#888", label=NAMES[state]) for state in states]
    if with_track:
        handles.append(Line2D([], [], color=PATH_COLOUR, label="the robot's path, from dot to square"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=11, labelcolor=INK)


DPI = 140
DIFFERENCE_WIDTH = 12.0
"""Inches."""
BOTH_FREE, BOTH_OCCUPIED, BOTH_UNKNOWN = 10, 11, 12
"""Classes of cells that do not differ."""
KINDS = {
    BOTH_UNKNOWN: ("unknown to both", "#cfd4db"),
    BOTH_FREE: ("both free", "#eef1f4"),
    Difference.FORGIVEN: ("differs, but excluded", "#9bc59d"),
    Difference.MISSED: ("missed: only the reference knows", "#8fb8de"),
    Difference.EXTRA: ("extra: only the map knows", "#e9c46a"),
    BOTH_OCCUPIED: ("both occupied", "#5a6577"),
    Difference.WRONGLY_FREE: ("wrongly free", "#8b1e5b"),
    Difference.WRONGLY_OCCUPIED: ("wrongly occupied", "#d1603d"),
}
"""Name and colour; if one pixel covers several cells, the last of these is shown."""


def binary_png(laid: AlignedGrids) -> bytes:
    """Return a PNG with one pixel per cell, north up: white where the maps differ, else black (IST 2019)."""
    from matplotlib.image import imsave

    out = io.BytesIO()
    imsave(out, wrong(differences(laid))[::-1], cmap="gray", vmin=0, vmax=1, format="png")
    return out.getvalue()


def classes(laid: AlignedGrids) -> NDArray[np.uint8]:
    """Return for each cell, (rows, columns) uint8, its `Difference`, or if there is none the common state."""
    found = differences(laid)
    same = np.full(len(State), BOTH_UNKNOWN, np.uint8)
    same[State.FREE], same[State.OCCUPIED] = BOTH_FREE, BOTH_OCCUPIED
    return np.where(found == Difference.SAME, same[three_states(laid.reference)], found)


def difference_png(laid: AlignedGrids) -> bytes:
    """Return a PNG with the kinds of difference in colours, in metres of the reference's frame."""
    box = _box(laid)
    figure, (axis,) = _panels(box, 1)
    paint(axis, laid.reference, classes(laid), {int(kind): colour for kind, (_, colour) in KINDS.items()})
    axis.set_facecolor(KINDS[BOTH_UNKNOWN][1])
    framed(axis, box)
    _legend(figure)
    return png_of(figure, DPI)


def side_by_side_png(laid: AlignedGrids, names: tuple[str, str] = ("Reference", "Map")) -> bytes:
    """Return a PNG of the reference, the map, and the binary difference (white: an error), all in one frame."""
    box = _box(laid)
    figure, panels = _panels(box, 3)
    max_px = int(0.74 * DPI * DIFFERENCE_WIDTH) // (1 if _is_wide(box) else 3)
    for axis, grid in zip(panels, (laid.reference, laid.map), strict=False):
        plan(axis, grid, max_px=max_px)
    paint(panels[2], laid.reference, wrong(differences(laid)).astype(np.uint8), {0: "black", 1: "white"}, max_px)
    panels[2].set_facecolor("black")
    for axis, name in zip(panels, (*names, "Difference (white: an error)"), strict=True):
        axis.set(xlim=(box[0][0], box[1][0]), ylim=(box[0][1], box[1][1]))
        title(axis, name)
    return png_of(figure, DPI)


def _box(laid: AlignedGrids) -> Box:
    """Return the box of all cells known to either map."""
    box = bounds(replace(laid.reference, cells=np.maximum(laid.map.cells, laid.reference.cells)))
    return box if box is not None else (np.zeros(2), np.ones(2))


def _is_wide(box: Box) -> bool:
    width, height = box[1] - box[0]
    return bool(height < 0.5 * width)


def _panels(box: Box, number: int) -> tuple[Any, list[Any]]:
    """Return a figure with panels side by side or, for wide maps, stacked."""
    width, height = box[1] - box[0]
    rows, columns = (number, 1) if _is_wide(box) else (1, number)
    inches = float(np.clip(0.93 * DIFFERENCE_WIDTH / columns * height / width, 1.6, 11.0)) + 0.7
    figure = blank(DIFFERENCE_WIDTH, inches * rows + (0.8 if number == 1 else 0))
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def _legend(figure: Any) -> None:
    from matplotlib.patches import Patch

    patches = [Patch(fc=colour, ec="#888", label=name) for name, colour in KINDS.values()]
    figure.legend(handles=patches, loc="outside lower center", ncols=4, frameon=False, fontsize=10)
