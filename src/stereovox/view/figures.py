# SPDX-License-Identifier: Apache-2.0
"""What all pictures share: a figure with a headline, saved as PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.files import replacing
from stereovox.maps import VoxelMap
from stereovox.view.panels import GREY, INK

DPI = 120
WIDTH = 16.0
"""Width of a page in inches."""


def figure_of(height: float) -> Any:
    """Return an empty page, `height` inches high, with room for a headline."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    headline = 0.95
    layout = ConstrainedLayoutEngine(rect=(0.005, 0.005, 0.99, 1 - headline / height))
    figure = Figure((WIDTH, height), facecolor="white", layout=layout)
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


def save(figure: Any, path: str | Path) -> None:
    """Save a figure as PNG. Raises StereovoxError for another ending or a file that cannot be written."""
    if Path(path).suffix.lower() != ".png":
        raise StereovoxError(f"{path}: pictures are PNG files; give a name that ends in .png")
    with replacing(path, StereovoxError) as file:
        figure.savefig(file, dpi=DPI, format="png")
