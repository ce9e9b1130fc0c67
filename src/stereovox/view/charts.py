# SPDX-License-Identifier: Apache-2.0
"""What the charts in reports share: an empty figure, grey labels, and the figure as PNG."""

from __future__ import annotations

import io
from typing import Any

from stereovox.view.panels import GREY, LINE


def blank(width: float, height: float) -> Any:
    """Return an empty figure of this size in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    made = Figure((width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(made)
    return made


def labels(axis: Any, x: str, y: str, letters: float = 9) -> None:
    """Label both axes of a chart in grey, ticks with `letters` points; an empty `x` leaves that axis as it is."""
    if x:
        axis.set_xlabel(x, color=GREY)
    axis.set_ylabel(y, color=GREY)
    axis.tick_params(colors=GREY, labelsize=letters)
    for spine in axis.spines.values():
        spine.set_color(LINE)


def png_of(figure: Any, dpi: int) -> bytes:
    """Return a figure as the bytes of a PNG."""
    out = io.BytesIO()
    figure.savefig(out, dpi=dpi, format="png")
    return out.getvalue()
