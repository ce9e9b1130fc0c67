# SPDX-License-Identifier: Apache-2.0
"""What all pictures share: a figure with a headline, saved as dots or as vectors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.files import replacing
from stereovox.maps import VoxelMap
from stereovox.view.panels import GREY, INK

DPI = 120
ENDINGS = (".png", ".pdf", ".svg")
LEAST_DPI, MOST_DPI = 20, 2400
WIDTH = 16.0
"""Width of a page in inches."""


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


def headline(figure: Any, voxel_map: VoxelMap, text: str) -> None:
    """Write the title, and below it what the map is."""
    counts = voxel_map.counts()
    facts = [f"cells of {voxel_map.voxel_size:g} m", f"{voxel_map.frames:,} frames"]
    facts += [f"{counts[state]:,} {state}" for state in ("occupied", "free", "tentative")]
    words_above(figure, text, facts)


def words_above(figure: Any, text: str, facts: Sequence[str]) -> None:
    """Write a title, and below it a line of facts."""
    figure.text(0.02, 1 - 0.42 / figure.get_figheight(), text, fontsize=20, weight="bold", color=INK)
    figure.text(0.02, 1 - 0.76 / figure.get_figheight(), "   ·   ".join(facts), fontsize=12.5, color=GREY)


def save(figure: Any, path: str | Path, dpi: float | None = None) -> None:
    """Save a figure: as dots (.png), or letters and lines as vectors, with text as text (.pdf, .svg).

    dpi: dots an inch; by default the figure's own. In .pdf and .svg it is that of the cells, where these are an image.
    Raises StereovoxError for another ending, dots that cannot be, or a file that cannot be written.
    """
    from matplotlib import rc_context

    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise StereovoxError(f"{path}: pictures are .png, .pdf or .svg; give a name that ends so")
    if dpi is not None and not LEAST_DPI <= dpi <= MOST_DPI:
        raise StereovoxError(f"--dpi {dpi:g}: give {LEAST_DPI} to {MOST_DPI} dots an inch")
    undated = {".png": None, ".pdf": {"CreationDate": None}, ".svg": {"Date": None}}[ending]
    with replacing(path, StereovoxError) as file, rc_context({"pdf.fonttype": 42, "svg.fonttype": "none"}):
        figure.savefig(file, dpi=dpi or figure.dpi, format=ending[1:], metadata=undated)
