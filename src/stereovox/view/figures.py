# SPDX-License-Identifier: Apache-2.0
"""Parts shared by all pictures: figures with a headline, legends, axes, saving."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import replacing
from stereovox.maps import VoxelMap
from stereovox.view.panels import GREY, INK, LINE

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
