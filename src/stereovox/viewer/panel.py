# SPDX-License-Identifier: Apache-2.0
"""Contents of the viewer's panel: statistics, colour bars, and the log-odds along the optical axis."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.maps import VoxelMap
from stereovox.view.layer import draw_profile

WIDTH_IN, DPI = 4.8, 180
"""Width of the panel's pictures in inches, relative to text size, and pixels per inch."""

BOTH = "#7d8695"
"""A grey that is legible on white and on black."""


def statistics(voxel_map: VoxelMap) -> str:
    """Describe the contents of a map as Markdown."""
    counts, bounds = voxel_map.counts(), voxel_map.bounds()
    rows = {state: f"{counts[state]:,}" for state in ("occupied", "free", "tentative")}
    rows["cell"] = f"{voxel_map.voxel_size:g} m"
    for axis, name in enumerate("xyz" if bounds is not None else ""):
        low, high = bounds[:, axis] if bounds is not None else (0, 0)
        rows[name] = f"{low:.2f} to {high:.2f} m"
    rows["frames"] = f"{voxel_map.frames:,} ({voxel_map.frames_refused:,} refused)"
    if (loops := voxel_map.history.loops) is not None:
        rows["loops"] = f"{loops.closed.number:,} closed, {loops.refused.number:,} refused"
    rows["memory"] = f"{voxel_map.memory_bytes / 1e6:,.1f} MB"
    rows["profile"] = plain(voxel_map.config.profile)
    if voxel_map.recording:
        rows["recording"] = plain(voxel_map.recording)
    lines = ["| | |", "|:--|:--|", *(f"| {name} | {value} |" for name, value in rows.items())]
    return "\n".join(lines if bounds is not None else ["This map is empty: no cell is known yet.", "", *lines])


def plain(text: str) -> str:
    """Escape text so that Markdown shows it literally.

    The page would execute `{...}` and `<...>`, and a map may be from someone else.
    """
    text = " ".join(text.encode("utf-8", "replace").decode().split())
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


def colour_bar(scale: Any, label: str, limits: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """Return a picture (H, W, 4) of a colour bar for a matplotlib mappable, legible on light and dark pages.

    limits: its ends.
    """
    figure = _figure(0.8, "none")
    bar = figure.colorbar(scale, cax=figure.add_subplot(), orientation="horizontal")
    if limits is not None:
        bar.ax.set_xlim(limits)
    bar.set_label(label, color=BOTH)
    bar.ax.tick_params(colors=BOTH)
    bar.outline.set_visible(False)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba()).copy()


def axis_chart(voxel_map: VoxelMap) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) of the log-odds along the optical axis (Chien 2020, Fig 4.6).

    Raises StereovoxError if the map has no camera.
    """
    figure = _figure(2.9)
    axis = figure.add_subplot()
    draw_profile(axis, voxel_map)
    axis.set_title("", loc="left")  # a panel has no room for it
    axis.set_xlabel("distance from the camera [m]")
    if axis.get_legend() is not None:
        axis.get_legend().remove()
    return _pixels(figure)


def _figure(height: float, page: str = "white") -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((WIDTH_IN, height), dpi=DPI, facecolor=page, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _pixels(figure: Any) -> NDArray[np.uint8]:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
