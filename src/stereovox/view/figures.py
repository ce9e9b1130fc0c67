# SPDX-License-Identifier: Apache-2.0
"""Parts shared by all pictures: figures with a headline, legends, axes, panels, saving, dark versions."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import replacing
from stereovox.maps import State, VoxelMap
from stereovox.view.drawn import Drawn
from stereovox.view.render import Direction, render

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


DPI = 120
ENDINGS = (".png", ".pdf", ".svg")
MIN_DPI, MAX_DPI = 20, 2400
WIDTH = 16.0
"""Width of a page in inches."""


def keep_clear(axis: Any) -> None:
    """Move the legend above a panel into a column at its right if it would cover the panel's title.

    Call it once all panels of the figure exist: only the finished layout determines this one's width.
    """
    axis.figure.draw_without_rendering()
    legend = axis.get_legend()
    if not covered(axis):
        return
    axis.legend(
        handles=legend.legend_handles,
        labels=[text.get_text() for text in legend.get_texts()],
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        frameon=False,
        handlelength=1.2,
        fontsize=legend.get_texts()[0].get_fontsize(),
    )


def covered(axis: Any) -> bool:
    """Return whether the legend of a drawn panel touches its title."""
    from matplotlib.text import Text

    words = axis.get_title(loc="left")
    title = next(one for one in axis.get_children() if isinstance(one, Text) and one.get_text() == words)
    return bool(axis.get_legend().get_window_extent().overlaps(title.get_window_extent()))


def blank(width: float, height: float) -> Any:
    """Return an empty figure of this size in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def labels(axis: Any, x: str, y: str, letters: float = 9) -> None:
    """Label both axes of a chart in grey, ticks with `letters` points; an empty `x` leaves that axis unchanged."""
    if x:
        axis.set_xlabel(x, color=GREY)
    axis.set_ylabel(y, color=GREY)
    axis.tick_params(colors=GREY, labelsize=letters)
    for spine in axis.spines.values():
        spine.set_color(LINE)


def png_of(figure: Any, dpi: int) -> bytes:
    """Return a figure as PNG bytes."""
    out = io.BytesIO()
    figure.savefig(out, dpi=dpi, format="png")
    return out.getvalue()


def figure_of(height: float) -> Any:
    """Return an empty page, `height` inches high, with room for a headline."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    headline = 0.95
    layout = ConstrainedLayoutEngine(rect=(0.005, 0.005, 0.99, 1 - headline / height))
    figure = Figure((WIDTH, height), dpi=DPI, facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    return figure


def headline(figure: Any, voxel_map: VoxelMap, text: str, more: Sequence[str] = ()) -> None:
    """Write the title, and below it the facts of the map, and `more` of them."""
    counts = voxel_map.counts()
    facts = [f"cells of {voxel_map.voxel_size:g} m", f"{voxel_map.frames:,} frames"]
    facts += [f"{counts[state]:,} {state}" for state in ("occupied", "free", "tentative")]
    title_above(figure, text, [*facts, *more])


def title_above(figure: Any, text: str, facts: Sequence[str]) -> None:
    """Write a title, and below it a line of facts."""
    figure.text(0.02, 1 - 0.42 / figure.get_figheight(), text, fontsize=20, weight="bold", color=INK)
    figure.text(0.02, 1 - 0.76 / figure.get_figheight(), "   ·   ".join(facts), fontsize=12.5, color=GREY)


def checked_ending(path: str | Path, dpi: float | None = None) -> str:
    """Return the suffix of a picture's file; raises StereovoxError as `save`, before anything is drawn."""
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise StereovoxError(f"{path}: pictures are .png, .pdf or .svg; give a name that ends so")
    if dpi is not None and not MIN_DPI <= dpi <= MAX_DPI:
        raise StereovoxError(f"--dpi {dpi:g}: give {MIN_DPI} to {MAX_DPI} dots an inch")
    return ending


def save(figure: Any, path: str | Path, dpi: float | None = None) -> None:
    """Save a figure as pixels (.png) or vectors with text as text (.pdf, .svg).

    dpi: dots per inch; by default the figure's own. In .pdf and .svg it applies to cells drawn as an image.
    Raises StereovoxError for another suffix, an invalid dpi, or a file that cannot be written.
    """
    from matplotlib import rc_context

    ending = checked_ending(path, dpi)
    undated = {".png": None, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}[ending]
    with replacing(path, StereovoxError) as file, rc_context({"pdf.fonttype": 42, "svg.fonttype": "none"}):
        figure.savefig(file, dpi=dpi or figure.dpi, format=ending[1:], metadata=undated)


PAGE = "#12161d"
MAX_STATES = 16
"""Colour maps with more colours are scales, which are kept."""
COLOURS = {
    "#ffffff": PAGE,
    "#000000": "#eef1f6",
    INK: "#eef1f6",
    GREY: "#a5aebd",
    LINE: "#3a4352",
    STATE_COLOURS[State.UNKNOWN]: "#232a35",
    STATE_COLOURS[State.FREE]: "#4a5568",
    STATE_COLOURS[State.OCCUPIED]: "#f4f6fa",
    "#f3f4f6": "#1a2029",
    "#dfe2e7": "#2b3340",
}
"""Colours of light pages, and their replacements; all others are kept."""


def darken(figure: Any) -> None:
    """Turn a finished figure of this package into one on a dark page."""
    figure.draw_without_rendering()  # creates ticks and their labels
    for artist in figure.findobj():
        for name in ("color", "facecolor", "edgecolor", "markeredgecolor", "markerfacecolor"):
            _exchange(artist, name)
    for axis in figure.axes:
        for image in axis.images:
            _exchange_map(image)


def _exchange(artist: Any, name: str) -> None:
    get, put = getattr(artist, f"get_{name}", None), getattr(artist, f"set_{name}", None)
    if get is None or put is None:
        return
    colours = get()
    if isinstance(colours, np.ndarray) and colours.ndim == 2:
        put([_dark(one) for one in colours])
    elif colours is not None and len(colours):
        put(_dark(colours))


def _dark(colour: Any) -> Any:
    """Return a colour's replacement on a dark page, with the same opacity."""
    from matplotlib.colors import is_color_like, to_hex, to_rgba

    if not is_color_like(colour):  # "none" of a line's marker, for example
        return colour
    other = COLOURS.get(to_hex(colour))
    return colour if other is None else to_rgba(other, to_rgba(colour)[3])


def _exchange_map(image: Any) -> None:
    """Replace the flat colours of states; colours of heights and log-odds are kept."""
    from matplotlib.colors import ListedColormap

    colours = image.get_cmap()
    if image.get_array().ndim == 2 and isinstance(colours, ListedColormap) and colours.N <= MAX_STATES:
        image.set_cmap(ListedColormap([_dark(one) for one in colours(np.arange(colours.N))]))
