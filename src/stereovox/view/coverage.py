# SPDX-License-Identifier: Apache-2.0
"""Picture of missions: the share of the air known to be free, over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stereovox.view.figures import DPI, blank, labels, png_of
from stereovox.view.panels import GREY, INK


def coverage_figure(flights: Sequence[dict[str, Any]]) -> Any:
    """Return a figure with a panel for each scene: a grey line for each flight, the median of all in black.

    flights: with `scene`, `seconds` and `coverage` [[seconds, share], ...]. A flight that ended keeps its last share;
    a red cross marks a collision.
    """
    scenes = list(dict.fromkeys(flight["scene"] for flight in flights))
    longest = max(flight["coverage"][-1][0] for flight in flights)
    figure = blank(1.2 + 3.6 * len(scenes), 3.4)
    for axis, scene in zip(np.ravel(figure.subplots(1, len(scenes), sharey=True, squeeze=False)), scenes, strict=True):
        mine = [flight for flight in flights if flight["scene"] == scene]
        times = np.linspace(0, longest, 200)
        curves = [np.interp(times, *np.transpose(flight["coverage"])) for flight in mine]
        for flight in mine:
            axis.plot(*np.transpose(flight["coverage"]), color=GREY, linewidth=0.6, alpha=0.6)
            if flight["collided_s"] is not None:
                axis.plot(*flight["coverage"][-1], "x", color="tab:red")
        axis.plot(times, np.median(curves, axis=0), color=INK, linewidth=1.8)
        axis.set_title(f"{scene}, {len(mine)} flights", loc="left", fontsize=9)
        axis.set(ylim=(0, 1), xlim=(0, longest or 1))
        labels(axis, "seconds", "air known to be free" if scene == scenes[0] else "")
    return figure


def coverage_png(flights: Sequence[dict[str, Any]]) -> bytes:
    """Return `coverage_figure` as PNG bytes."""
    return png_of(coverage_figure(flights), DPI)
