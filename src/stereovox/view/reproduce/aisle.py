# SPDX-License-Identifier: Apache-2.0
"""A picture of an aisle, mapped in several ways (Chien 2020, Fig 4.12)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.reproduce.aisle import FAR_M, AisleFound
from stereovox.products.slices import layer
from stereovox.sources.scene import Solid
from stereovox.view.charts import labels
from stereovox.view.panels import GREY, STATE_COLOURS, title
from stereovox.view.reproduce.shared import SECOND, cut, figure_of, png


def aisle_png(found: Sequence[AisleFound], solids: Sequence[Solid]) -> bytes:
    """Return the layer at the camera's height of every variant, the aisle lying on its side (after Fig 4.12)."""
    figure = figure_of(1.75 * len(found) + 0.5)
    axes = figure.subplots(len(found), 1, sharex=True, squeeze=False)[:, 0]
    for axis, one in zip(axes, found, strict=True):
        cut_open = layer(one.voxel_map, "y", 0.0)
        axis.imshow(_state_image(cut_open.state.T), origin="lower", interpolation="nearest",
                    extent=(*cut_open.extent[2:], *cut_open.extent[:2]))  # fmt: skip
        for solid in solids:
            polygon = cut(solid, 0.0)
            if len(polygon) > 2:
                axis.fill(*polygon[:, ::-1].T, fill=False, edgecolor=SECOND, linewidth=0.9)
        axis.axvline(FAR_M, color=GREY, linewidth=1, linestyle=":")
        axis.set(xlim=(-0.3, 13.0), ylim=(-0.85, 0.85))
        title(axis, f"{one.variant.name}: {100 * one.found:.0f} % of the far walls' cells")
        labels(axis, "", "x [m]")
    axes[-1].set_xlabel("distance [m]; right of the dotted line is far", color=GREY)
    return png(figure)


def _state_image(states: NDArray[np.uint8]) -> NDArray[np.uint8]:
    colours = [[int(STATE_COLOURS[state][i : i + 2], 16) for i in (1, 3, 5)] for state in sorted(STATE_COLOURS)]
    return np.array(colours, np.uint8)[states]
