# SPDX-License-Identifier: Apache-2.0
"""Picture of a spherical grid: all directions around the vehicle, coloured by distance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.depth.sphere import SphereGrid
from stereovox.frame import Reason
from stereovox.view.figures import GREY, INK, figure_of, save

UNKNOWN = "#8d9296"
FREE = "#e9eef2"
TOO_NEAR = "#d11149"
COLOURS = "turbo_r"
"""Near is red, far is blue."""
NEAREST, FARTHEST = 0.3, 10.0
"""Minimum span of the logarithmic colour scale in metres, as far as the grid has such ranges."""


def sphere_picture(
    grid: SphereGrid, path: str | Path, *, title: str = "Surroundings", now_ns: int | None = None
) -> None:
    """Write a PNG of the grid: azimuth across (left is left, the middle ahead), elevation upwards.

    now_ns: reference time of ages (default: the grid's newest). Raises StereovoxError for a name that does not end
    in .png or a file that cannot be written.
    """
    save(draw_sphere(grid, title, now_ns), path)


def draw_sphere(grid: SphereGrid, title: str, now_ns: int | None = None) -> Any:
    """Return the matplotlib figure that `sphere_picture` saves."""
    figure = figure_of(8.6)
    axes = figure.subplots()
    ranges, reason = panorama(grid)
    near, far = _span(ranges[reason == Reason.VALID])
    shown = axes.imshow(
        _coloured(ranges, reason, near, far), extent=(180, -180, -90, 90), interpolation="nearest", aspect="equal"
    )
    shown.set_label("panorama")
    _decorate(axes)
    _legend(figure, axes, near, far)
    figure.text(0.02, 1 - 0.42 / 8.6, title, fontsize=20, weight="bold", color=INK)
    figure.text(0.02, 1 - 0.76 / 8.6, "   ·   ".join(_facts(grid, now_ns)), fontsize=12.5, color=GREY)
    return figure


def panorama(grid: SphereGrid) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return ranges in metres and reasons of all directions (polars, azimuths) as a panorama.

    First row: straight up; first column: behind, then left, ahead in the middle, right. Outside the grid: UNKNOWN.
    """
    whole, layout = grid.layout.whole(), grid.layout
    ranges = np.full(whole.shape, np.nan, np.float32)
    reason = np.full(whole.shape, Reason.UNKNOWN, np.uint8)
    place = np.ix_(*layout.places_in(whole))
    ranges[place], reason[place] = grid.range_m, grid.reason
    return ranges[::-1].T, reason[::-1].T


def _coloured(ranges: NDArray[np.float32], reason: NDArray[np.uint8], near: float, far: float) -> NDArray[np.float64]:
    from matplotlib import colormaps
    from matplotlib.colors import LogNorm, to_rgb

    image = np.empty((*ranges.shape, 3))
    image[:] = to_rgb(UNKNOWN)
    surface = reason == Reason.VALID
    image[surface] = colormaps[COLOURS](LogNorm(near, far, clip=True)(ranges[surface]))[:, :3]
    image[reason == Reason.TOO_FAR], image[reason == Reason.TOO_NEAR] = to_rgb(FREE), to_rgb(TOO_NEAR)
    return image


def _decorate(axes: Any) -> None:
    names = {180: "back", 90: "left", 0: "front", -90: "right", -180: "back"}
    axes.set_xticks(list(range(-180, 181, 45)))
    axes.set_xticklabels([f"{angle}°\n{names.get(angle, '')}" for angle in range(-180, 181, 45)])
    axes.set_yticks(list(range(-90, 91, 30)))
    axes.set_yticklabels([f"{angle}°" for angle in range(-90, 91, 30)])
    axes.set_ylabel("elevation", color=GREY)
    axes.grid(color="white", linewidth=0.5, alpha=0.35)
    axes.tick_params(colors=GREY, labelsize=11)


def _legend(figure: Any, axes: Any, near: float, far: float) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Patch
    from matplotlib.ticker import FixedLocator, NullLocator

    bar = figure.colorbar(ScalarMappable(LogNorm(near, far), COLOURS), ax=axes, shrink=0.75, pad=0.015)
    ticks = [t for t in (0.1, 0.2, 0.3, 0.5, 1, 2, 3, 5, 10, 20, 30, 50, 100, 200) if near <= t <= far]
    bar.ax.yaxis.set_major_locator(FixedLocator(ticks))
    bar.ax.yaxis.set_minor_locator(NullLocator())
    bar.ax.set_yticklabels([f"{tick:g} m" for tick in ticks], color=GREY, fontsize=11)
    entries = ((UNKNOWN, "unknown"), (FREE, "free as far as seen"), (TOO_NEAR, "too near to measure"))
    patches = [Patch(facecolor=colour, edgecolor=GREY, linewidth=0.4, label=text) for colour, text in entries]
    axes.legend(handles=patches, loc="upper right", bbox_to_anchor=(1, -0.09), ncols=3, frameon=False, fontsize=11)


def _span(ranges: NDArray[np.float32]) -> tuple[float, float]:
    if not len(ranges):
        return NEAREST, FARTHEST
    near, far = np.percentile(ranges, (0.5, 99.5))
    near = max(float(near), 0.05)
    return near, max(float(far), 2 * near)


def _facts(grid: SphereGrid, now_ns: int | None) -> list[str]:
    facts = [f"cells of {np.degrees(grid.layout.step):g}°"]
    if not grid.known.any():
        return [*facts, "nothing is known"]
    stamps = grid.stamp_ns[grid.known]
    oldest = ((int(stamps.max()) if now_ns is None else now_ns) - int(stamps.min())) / 1e9
    solid = np.broadcast_to(np.sin(grid.layout.polar()), grid.layout.shape)
    share = solid[grid.known].sum() / (np.sin(grid.layout.whole().polar()).sum() * 2 * grid.layout.per_half_turn)
    facts.append(f"{100 * share:.0f} % of all directions seen")
    surfaces = grid.range_m[grid.reason == Reason.VALID]
    facts += [f"nearest surface {surfaces.min():.2f} m"] if len(surfaces) else []
    return [*facts, f"oldest {oldest:.1f} s"]
