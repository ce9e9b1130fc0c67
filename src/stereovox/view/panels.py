# SPDX-License-Identifier: Apache-2.0
"""Panels of a picture: a view of the occupied cells, and a slice with all four states."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.maps import State
from stereovox.view.scene.drawn import Drawn
from stereovox.view.scene.render import Direction, render

INK, GREY, LINE = "#1b2333", "#555d6b", "#c8cdd5"
STATE_COLOURS = {
    State.UNKNOWN: "#c9ced6",
    State.FREE: "#fbfaf5",
    State.TENTATIVE: "#e8a33d",
    State.OCCUPIED: "#22304a",
}
PATH_COLOUR = "#e0452f"
HALO = "#fdfdfd"
"""Rim of a path, also white on dark pages."""


def title(axis: Any, text: str) -> None:
    """Write a panel's title."""
    axis.set_title(text, loc="left", fontsize=12.5, color=INK)


def view(axis: Any, drawn: Drawn, colours: NDArray[np.floating], direction: Direction, width_px: int) -> None:
    """Draw the occupied cells below the ceiling as cubes in `colours` (N, 3), seen from `direction`."""
    cells = drawn.below_ceiling
    rendering = render(cells, colours, drawn.voxel_size, direction, width_px, width_px, drawn.occlusion)
    axis.imshow(rendering.image, extent=rendering.extent, interpolation="antialiased")
    if drawn.path is not None:
        flat = direction.flat(drawn.path)
        trajectory(axis, flat, rendering.hidden(flat, drawn.path @ direction.toward, drawn.voxel_size))


def oblique(axis: Any, drawn: Drawn, colours: NDArray[np.floating], direction: Direction, width_px: int) -> None:
    """Draw a view without axes, with a scale bar and arrows along the map's axes."""
    view(axis, drawn, colours, direction, width_px)
    axis.set_axis_off()
    left, right = axis.get_xlim()
    bottom, top = axis.get_ylim()
    axis.set(xlim=(left, right), ylim=(bottom - 0.1 * (top - bottom), top))
    scale_bar(axis)
    _triad(axis, direction, drawn.names, _emptiest_corner(axis.images[0].get_array()))


def slice_(axis: Any, drawn: Drawn) -> None:
    """Draw one layer of cells with the colours of all four states and a legend."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    low, high = drawn.cells[:, :2].min(0), drawn.cells[:, :2].max(0) + 1
    layer = drawn.cells[:, 2] == drawn.layer
    x, y = (drawn.cells[layer][:, :2] - low).T
    image = np.zeros((high - low)[::-1], np.uint8)
    image[y, x] = drawn.state[layer]
    extent = np.column_stack([low, high]).ravel() * drawn.voxel_size
    colours = ListedColormap([STATE_COLOURS[state] for state in State])
    axis.imshow(image, cmap=colours, vmin=0, vmax=3, origin="lower", extent=extent, interpolation="nearest")
    axis.set_facecolor(STATE_COLOURS[State.UNKNOWN])  # the path may leave known cells
    between = " to ".join(f"{number * drawn.voxel_size:.2f}" for number in (drawn.layer, drawn.layer + 1))
    title(axis, f"Slice at {drawn.names[2]} = {between} m")
    if drawn.path is not None:
        trajectory(axis, drawn.path[:, :2])
    patches = [Patch(fc=colour, ec="#888", label=state.name.lower()) for state, colour in STATE_COLOURS.items()]
    axis.legend(
        handles=patches,
        loc="lower right",
        bbox_to_anchor=(1.005, 1),
        ncols=4,
        frameon=False,
        borderaxespad=0.3,
        handlelength=1.2,
        handletextpad=0.5,
        columnspacing=1.2,
        fontsize=10.5,
    )
    measured(axis, drawn.names)


def measured(axis: Any, names: tuple[str, str, str]) -> None:
    """Label the axes of a top view."""
    axis.set_xlabel(f"{names[0]} [m]", color=GREY)
    axis.set_ylabel(f"{names[1]} [m]", color=GREY)
    axis.tick_params(colors=GREY, labelsize=9)
    for spine in axis.spines.values():
        spine.set_color(LINE)


def trajectory(axis: Any, points: NDArray[np.float64], hidden: NDArray[np.bool_] | None = None) -> None:
    """Draw a path (N, 2) with NaN at breaks, from a dot to a square; pale where it is `hidden` (N,)."""
    whole = points[np.isfinite(points).all(axis=1)]
    if not len(whole):
        return
    if hidden is not None:
        axis.plot(*points.T, color=PATH_COLOUR, linewidth=1.2, alpha=0.45)
        points = np.where(hidden[:, None], np.nan, points)
    axis.plot(*points.T, color=HALO, linewidth=3.2, alpha=0.75, solid_capstyle="round")
    axis.plot(*points.T, color=PATH_COLOUR, linewidth=1.6, solid_capstyle="round")
    for end, marker in ((whole[:1], "o"), (whole[-1:], "s")):
        axis.plot(*end.T, marker, color=PATH_COLOUR, markeredgecolor=HALO, markersize=7)


def scale_bar(axis: Any) -> None:
    """Draw a labelled scale bar of a round length at the lower right of a panel in metres."""
    left, right = axis.get_xlim()
    bottom, top = axis.get_ylim()
    length = round_length((right - left) / 6)
    y = bottom + 0.02 * (top - bottom)
    axis.plot([right - length, right], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt")
    axis.text(right - length / 2, y + 0.012 * (top - bottom), f"{length:g} m", ha="center", va="bottom", fontsize=10)
    axis.set(xlim=(left, right), ylim=(bottom, top))


def round_length(length: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten not above `length`."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(step for step in (1, 2, 5) if step * power <= length * 1.0001) * power)


def _emptiest_corner(image: Any) -> str:
    rows, columns = (size // 4 for size in image.shape[:2])
    alpha = np.asarray(image)[..., 3]
    corners = {
        "lower left": alpha[-rows:, :columns],
        "upper left": alpha[:rows, :columns],
        "upper right": alpha[:rows, -columns:],
    }
    return min(corners, key=lambda name: corners[name].mean())


def _triad(axis: Any, direction: Direction, names: tuple[str, str, str], corner: str) -> None:
    from matplotlib.offsetbox import AnchoredOffsetbox, DrawingArea
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.text import Text

    area = DrawingArea(64, 64, 0, 0)
    tips = direction.flat(np.eye(3)) * 22
    above = (0, 0, 6)  # the longer word clears the other two
    for name, (x, y), higher in zip((*names[:2], f"{names[2]} up"), tips, above, strict=True):
        area.add_artist(
            FancyArrowPatch(
                (32, 32), (32 + x, 32 + y), arrowstyle="-|>", mutation_scale=9, color=GREY, shrinkA=0, shrinkB=0
            )
        )
        area.add_artist(
            Text(32 + 1.3 * x, 32 + 1.3 * y + higher, name, ha="center", va="center", fontsize=9, color=GREY)
        )
    axis.add_artist(AnchoredOffsetbox(corner, child=area, pad=0, borderpad=0, frameon=False))
