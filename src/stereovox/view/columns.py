# SPDX-License-Identifier: Apache-2.0
"""A map from above as a background: the more of a column is occupied, the darker it is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.products.ground_surfaces import Floor
from stereovox.view.figures import WIDTH, figure_of
from stereovox.view.panels import INK, STATE_COLOURS, State, measured, scale_bar

SHADE = 0.8
"""How much a mark covers."""
DARKEST = 0.75
"""How much of the ink a column gets that is as full as most walls."""


def page_of(floor: Floor, panels: int = 1) -> tuple[Any, list[Any]]:
    """Return a figure that fits panels of a floor, side by side, and these."""
    rows, columns = floor.shape
    figure = figure_of(float(np.clip(0.9 * WIDTH / panels * rows / columns, 3, 13)) + 2.0)
    return figure, list(figure.subplots(1, panels, squeeze=False)[0])


def draw_columns(axis: Any, floor: Floor) -> None:
    """Draw what is known of each column of a floor."""
    from matplotlib.colors import to_rgb

    unknown, free, ink = (
        np.array(to_rgb(name)) for name in (STATE_COLOURS[State.UNKNOWN], STATE_COLOURS[State.FREE], INK)
    )
    occupied = _number(floor, floor.voxel_map.occupied())
    known = (occupied + _number(floor, floor.voxel_map.free())) > 0
    full = np.percentile(occupied[occupied > 0], 90) if occupied.any() else 1
    share = DARKEST * np.minimum(occupied / full, 1)[..., None]
    show(axis, floor, np.where(known[..., None], free * (1 - share) + ink * share, unknown))


def show(axis: Any, floor: Floor, image: NDArray, **how: Any) -> Any:
    """Draw an image (rows, columns) or (rows, columns, 3) of a floor in metres; return what matplotlib does."""
    (rows, columns), side, (x, y, _) = floor.shape, floor.resolution, floor.origin
    extent = (x, x + columns * side, y, y + rows * side)
    drawn = axis.imshow(image, origin="lower", extent=extent, interpolation="nearest", **how)
    axis.set_facecolor(STATE_COLOURS[State.UNKNOWN])
    measured(axis, ("xyz"[floor.axes[0]], "xyz"[floor.axes[1]], ""))
    return drawn


def mark(axis: Any, floor: Floor, points: ArrayLike, colour: str) -> None:
    """Draw the columns that hold places (N, 3) in metres in one colour."""
    from matplotlib.colors import to_rgba

    image = np.zeros((*floor.shape, 4))
    image[_number(floor, points) > 0] = to_rgba(colour, SHADE)
    show(axis, floor, image)


def finish(axis: Any) -> None:
    """Put a scale bar in a strip below a panel."""
    bottom, top = axis.get_ylim()
    axis.set_ylim(bottom - 0.06 * (top - bottom), top)
    scale_bar(axis)


def _number(floor: Floor, points: ArrayLike) -> NDArray[np.int64]:
    """Return how many of the places (N, 3) lie in each column (rows, columns); those beyond the floor in none."""
    across = np.asarray(points, float).reshape(-1, 3)[:, floor.axes[:2]] / floor.resolution
    columns, rows = (np.floor(across).astype(np.int64) - floor.first).T
    inside = (rows >= 0) & (columns >= 0) & (rows < floor.shape[0]) & (columns < floor.shape[1])
    number = np.zeros(floor.shape, np.int64)
    np.add.at(number, (rows[inside], columns[inside]), 1)
    return number
