# SPDX-License-Identifier: Apache-2.0
"""Pictures of a map from above: its columns, changes, frontiers and ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.maps import State, VoxelMap
from stereovox.maps.storage.cubes import in_cubes
from stereovox.products.difference import Difference, difference
from stereovox.products.edit import merge
from stereovox.products.frontiers import Frontier
from stereovox.products.ground import Floor, Footing, Ground, floor_of
from stereovox.view.figures import GREY, INK, STATE_COLOURS, WIDTH, figure_of, measured, scale_bar, title, title_above

SHADE = 0.8
"""Opacity of a mark."""
DARKEST = 0.75
"""Share of full ink for a column as full as most walls."""
KINDS = {
    "became_known": ("became known", "#b9d8b0"),
    "became_unknown": ("became unknown", "#d9c7e0"),
    "vanished": ("vanished: occupied before, free now", "#2f7fd1"),
    "appeared": ("appeared: free before, occupied now", "#d8352a"),
}
"""Name and colour; a column with several kinds shows the last of them."""
COLOURS = ("#e0452f", "#2f7fd1", "#3a9a4b", "#c77d0a", "#8448a8", "#0f9aa0", "#c2408c", "#7a5a32")
LABELLED = 12
"""Number of frontiers, the largest, that are labelled with a number and their viewpoint."""
FOOTINGS = {
    Footing.DRIVABLE: ("drivable", "#a9d8a0"),
    Footing.TENTATIVE: ("not decided", "#e8c98a"),
    Footing.OBSTACLE: ("obstacle", "#22304a"),
    Footing.STEP: ("step", "#d8352a"),
    Footing.STEEP: ("too steep", "#e07b2a"),
    Footing.DROP: ("drop", "#7a3fa0"),
    Footing.UNKNOWN: ("unknown", STATE_COLOURS[State.UNKNOWN]),
}


def page_of(shape: tuple[int, int], panels: int = 1) -> tuple[Any, list[Any]]:
    """Return a figure for panels of this shape (rows, columns), side by side, and the panels."""
    rows, columns = shape
    figure = figure_of(float(np.clip(0.9 * WIDTH / panels * rows / columns, 3, 13)) + 2.0)
    return figure, list(figure.subplots(1, panels, squeeze=False)[0])


def draw_columns(axis: Any, floor: Floor) -> None:
    """Draw how full each column of a floor is."""
    from matplotlib.colors import to_rgb

    unknown, free, ink = (
        np.array(to_rgb(name)) for name in (STATE_COLOURS[State.UNKNOWN], STATE_COLOURS[State.FREE], INK)
    )
    occupied = _number(floor, floor.voxel_map.occupied())
    known = (occupied + _number(floor, floor.voxel_map.free())) > 0
    full = np.percentile(occupied[occupied > 0], 90) if occupied.any() else 1
    share = DARKEST * np.minimum(occupied / full, 1)[..., None]
    show(axis, floor, np.where(known[..., None], free * (1 - share) + ink * share, unknown))


def show(axis: Any, floor: Floor, image: NDArray, **how: Any) -> Any:
    """Draw an image (rows, columns) or (rows, columns, 3) of a floor in metres; return matplotlib's image."""
    (rows, columns), side, (x, y, _) = floor.shape, floor.resolution, floor.origin
    extent = (x, x + columns * side, y, y + rows * side)
    drawn = axis.imshow(image, origin="lower", extent=extent, interpolation="nearest", **how)
    measured(axis, ("xyz"[floor.axes[0]], "xyz"[floor.axes[1]], ""))
    return drawn


def mark(axis: Any, floor: Floor, points: ArrayLike, colour: str) -> None:
    """Draw the columns that contain points (N, 3), in metres, in one colour."""
    from matplotlib.colors import to_rgba

    image = np.zeros((*floor.shape, 4))
    image[_number(floor, points) > 0] = to_rgba(colour, SHADE)
    show(axis, floor, image)


def finish(axis: Any) -> None:
    """Add a scale bar in a strip below a panel."""
    axis.set_facecolor(STATE_COLOURS[State.UNKNOWN])
    bottom, top = axis.get_ylim()
    axis.set_ylim(bottom - 0.06 * (top - bottom), top)
    scale_bar(axis)


def _number(floor: Floor, points: ArrayLike) -> NDArray[np.int64]:
    """Count the points (N, 3) in each column (rows, columns); points beyond the floor are ignored."""
    across = np.asarray(points, float).reshape(-1, 3)[:, floor.axes[:2]] / floor.resolution
    columns, rows = (np.floor(across).astype(np.int64) - floor.first).T
    inside = (rows >= 0) & (columns >= 0) & (rows < floor.shape[0]) & (columns < floor.shape[1])
    number = np.zeros(floor.shape, np.int64)
    np.add.at(number, (rows[inside], columns[inside]), 1)
    return number


def draw_changes(a: VoxelMap, b: VoxelMap, heading: str) -> Any:
    """Return the matplotlib figure of the changes from map `a` to map `b`, of one frame and cell size."""
    from matplotlib.patches import Patch

    a, b = in_cubes(a), in_cubes(b)
    changes, both = difference(a, b), merge(a, b)
    floor = floor_of(both)
    figure, (axis,) = page_of(floor.shape)
    draw_columns(axis, floor)
    for kind, (_, colour) in KINDS.items():
        mark(axis, floor, both.centers(getattr(changes, kind)), colour)
    finish(axis)
    patches = [Patch(fc=colour, label=name) for name, colour in KINDS.values()]
    figure.legend(handles=patches, loc="outside lower center", ncols=4, frameon=False, fontsize=11, labelcolor=INK)
    title_above(figure, heading, [f"cells of {a.voxel_size:g} m", *facts(changes), "grey: both maps from above"])
    return figure


def facts(changes: Difference) -> list[str]:
    """Describe how many cells changed."""
    return [f"{len(getattr(changes, kind)):,} {kind.replace('_', ' ')}" for kind in reversed(KINDS)]


def draw_frontiers(voxel_map: VoxelMap, frontiers: Sequence[Frontier], heading: str) -> Any:
    """Return the matplotlib figure of the frontiers of a map, the largest on top."""
    floor = floor_of(voxel_map)
    figure, (axis,) = page_of(floor.shape)
    draw_columns(axis, floor)
    for n in reversed(range(len(frontiers))):
        mark(axis, floor, voxel_map.centers(frontiers[n].cells), COLOURS[n % len(COLOURS)])
    for n, frontier in enumerate(frontiers[:LABELLED]):
        _label(axis, frontier, n + 1, list(floor.axes[:2]))
    finish(axis)
    seen = sum(frontier.look_from is not None for frontier in frontiers)
    title_above(figure, heading, [
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


def draw_ground(voxel_map: VoxelMap, ground: Ground, heading: str) -> Any:
    """Return the matplotlib figure of the ground of a map: heights, and where the robot can drive."""
    from matplotlib.patches import Patch

    floor = floor_of(voxel_map)
    rows, columns = ground.grid.known_span
    if rows.stop == rows.start:  # nothing is decided: all of it
        rows, columns = (slice(0, number) for number in ground.footing.shape)
    shape = rows.stop - rows.start, columns.stop - columns.start
    figure, panels = page_of(shape, panels=2)
    _draw_heights(figure, panels[0], floor, ground)
    _draw_footing(panels[1], floor, ground)
    x, y, side = *ground.origin[:2], ground.resolution
    for panel in panels:
        panel.set_xlim(x + columns.start * side, x + columns.stop * side)
        panel.set_ylim(y + rows.start * side, y + rows.stop * side)
        finish(panel)
    patches = [Patch(fc=colour, ec="#888", label=name) for name, colour in FOOTINGS.values()]
    figure.legend(handles=patches, loc="outside lower center", ncols=7, frameon=False, fontsize=11, labelcolor=INK)
    area = np.count_nonzero(ground.footing == Footing.DRIVABLE) * ground.resolution**2
    title_above(figure, heading, [f"cells of {ground.resolution:g} m", f"{area:.1f} square metres drivable"])
    return figure


def _draw_heights(figure: Any, axis: Any, floor: Floor, ground: Ground) -> None:
    drawn = show(axis, floor, ground.height, cmap="viridis")
    bar = figure.colorbar(drawn, ax=axis, pad=0.01, fraction=0.03, aspect=25)
    bar.set_label(f"height {floor.voxel_map.config.up} [m]", color=GREY)
    bar.ax.tick_params(colors=GREY)
    bar.outline.set_visible(False)
    title(axis, "Height of the ground")


def _draw_footing(axis: Any, floor: Floor, ground: Ground) -> None:
    from matplotlib.colors import to_rgb

    colours = np.array([to_rgb(FOOTINGS[footing][1]) for footing in Footing])
    show(axis, floor, colours[ground.footing])
    title(axis, "What each place is to the robot")
