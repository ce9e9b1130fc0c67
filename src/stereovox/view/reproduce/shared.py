# SPDX-License-Identifier: Apache-2.0
"""What the pictures of a reproduction share."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.sources.scene import Solid
from stereovox.view.panels import GREY, LINE

DPI = 90
WIDTH = 14.0
"""Inches."""
THESIS, OURS, SECOND = "#b9c0cb", "#23618c", "#d1603d"


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


def labels(axis: Any, x: str, y: str) -> None:
    """Label both axes of a chart in grey."""
    axis.set_xlabel(x, color=GREY)
    axis.set_ylabel(y, color=GREY)
    axis.tick_params(colors=GREY, labelsize=9)
    for spine in axis.spines.values():
        spine.set_color(LINE)


def figure_of(height: float) -> Any:
    """Return an empty figure, `height` inches high."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure((WIDTH, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(made)
    return made


def png(figure: Any, dpi: int = DPI) -> bytes:
    """Return a figure as a PNG file."""
    out = io.BytesIO()
    figure.savefig(out, dpi=dpi, format="png")
    return out.getvalue()
