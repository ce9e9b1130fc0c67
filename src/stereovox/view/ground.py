# SPDX-License-Identifier: Apache-2.0
"""A picture of the ground: how high it is, and where a robot can drive."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereovox.maps import State, VoxelMap
from stereovox.products.ground import Footing, Ground
from stereovox.products.ground_surfaces import Floor, floor_of
from stereovox.view.columns import finish, page_of, show
from stereovox.view.figures import words_above
from stereovox.view.panels import GREY, INK, STATE_COLOURS, title

KINDS = {
    Footing.DRIVABLE: ("drivable", "#a9d8a0"),
    Footing.TENTATIVE: ("not decided", "#e8c98a"),
    Footing.OBSTACLE: ("obstacle", "#22304a"),
    Footing.STEP: ("step", "#d8352a"),
    Footing.STEEP: ("too steep", "#e07b2a"),
    Footing.DROP: ("drop", "#7a3fa0"),
    Footing.UNKNOWN: ("unknown", STATE_COLOURS[State.UNKNOWN]),
}


def draw_ground(voxel_map: VoxelMap, ground: Ground, heading: str) -> Any:
    """Return the matplotlib figure of the ground of a map: heights, and what each place is to the robot."""
    from matplotlib.patches import Patch

    floor = floor_of(voxel_map)
    rows, columns = ground.grid.known_span
    if rows.stop == rows.start:  # nothing is decided: all of it
        rows, columns = (slice(0, number) for number in ground.footing.shape)
    shape = rows.stop - rows.start, columns.stop - columns.start
    figure, panels = page_of(shape, panels=2)
    _draw_heights(figure, panels[0], floor, ground)
    _draw_footing(panels[1], floor, ground)
    x, y, side = *ground.origin[:2], ground.resolution
    for panel in panels:
        panel.set_xlim(x + columns.start * side, x + columns.stop * side)
        panel.set_ylim(y + rows.start * side, y + rows.stop * side)
        finish(panel)
    patches = [Patch(fc=colour, ec="#888", label=name) for name, colour in KINDS.values()]
    figure.legend(handles=patches, loc="outside lower center", ncols=7, frameon=False, fontsize=11, labelcolor=INK)
    area = np.count_nonzero(ground.footing == Footing.DRIVABLE) * ground.resolution**2
    words_above(figure, heading, [f"cells of {ground.resolution:g} m", f"{area:.1f} square metres drivable"])
    return figure


def _draw_heights(figure: Any, axis: Any, floor: Floor, ground: Ground) -> None:
    drawn = show(axis, floor, ground.height, cmap="viridis")
    bar = figure.colorbar(drawn, ax=axis, pad=0.01, fraction=0.03, aspect=25)
    bar.set_label(f"height {floor.voxel_map.config.up} [m]", color=GREY)
    bar.ax.tick_params(colors=GREY)
    bar.outline.set_visible(False)
    title(axis, "Height of the ground")


def _draw_footing(axis: Any, floor: Floor, ground: Ground) -> None:
    from matplotlib.colors import to_rgb

    colours = np.array([to_rgb(KINDS[footing][1]) for footing in Footing])
    show(axis, floor, colours[ground.footing])
    title(axis, "What each place is to the robot")
