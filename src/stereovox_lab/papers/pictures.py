# SPDX-License-Identifier: Apache-2.0
"""Parts shared by the pictures of reproductions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.simulate.scene import Solid
from stereovox.view.figures import blank, png_of

DPI = 90
WIDTH = 14.0
"""Inches."""
THESIS, OURS, SECOND = "#b9c0cb", "#23618c", "#d1603d"


def cut(solid: Solid, y: float) -> NDArray[np.float64]:
    """Return the corners (N, 2) in x and z of a convex solid's section at this height, in order; empty if none."""
    edges = np.concatenate([solid.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    a, b = edges[:, 0], edges[:, 1]
    crosses = (a[:, 1] < y) != (b[:, 1] < y)
    if not crosses.any():
        return np.zeros((0, 2))
    a, b = a[crosses], b[crosses]
    points = (a + (b - a) * ((y - a[:, 1]) / (b[:, 1] - a[:, 1]))[:, None])[:, [0, 2]]
    around = points - points.mean(0)
    return points[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]


def figure_of(height: float) -> Any:
    """Return an empty figure, `height` inches high."""
    return blank(WIDTH, height)


def png(figure: Any, dpi: int = DPI) -> bytes:
    """Return a figure as a PNG file."""
    return png_of(figure, dpi)
