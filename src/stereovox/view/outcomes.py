# SPDX-License-Identifier: Apache-2.0
"""Right and wrong cells of a map, seen from above."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.outcomes import Outcome, Outcomes
from stereovox.view.evaluation import DPI, WIDTH
from stereovox.view.figures import blank, png_of
from stereovox.view.panels import measured, title
from stereovox.view.scene.drawn import UPS, checked_up

RIGHT, WRONG, MISS, NEVER = "#2f7fb8", "#e59a1f", "#b3205f", "#b9bec7"
EXACT = {
    "right": (RIGHT, [Outcome.HIT]),
    "only in the map": (WRONG, [Outcome.NEAR, Outcome.FALSE]),
    "missed": (MISS, [Outcome.FOUND, Outcome.MISSED]),
    "never observed": (NEVER, [Outcome.UNSEEN]),
}
TOLERANT = {
    "right": (RIGHT, [Outcome.HIT, Outcome.NEAR, Outcome.FOUND]),
    "only in the map": (WRONG, [Outcome.FALSE]),
    "missed": (MISS, [Outcome.MISSED]),
    "never observed": (NEVER, [Outcome.UNSEEN]),
}


def outcomes_png(shown: Outcomes, up: str | None = None) -> bytes:
    """Return a PNG of two top views: exact, and with the tolerance.

    A column has the mean colour of its cells. up: the axis that points up, by default from the truth's settings. Raises
    StereovoxError for an invalid `up`.
    """
    up = checked_up(up or shown.up)
    across, away, _ = UPS[up]
    places = shown.cells[:, [across, away]]
    low = places.min(axis=0) if len(places) else np.zeros(2, int)
    size = (places.max(axis=0) - low + 1) if len(places) else np.ones(2, int)
    tall = size[1] > 0.6 * size[0]
    height = 0.8 + float(np.clip((0.46 if tall else 0.92) * WIDTH * size[1] / size[0], 2.0, 9.0))
    figure = blank(WIDTH, height if tall else 2 * height)
    panels = figure.subplots(*((1, 2) if tall else (2, 1)), squeeze=False).ravel()
    extent = np.stack([low, low + size], axis=1).ravel() * shown.voxel_size
    names = ("xyz"[across], "xyz"[away], up)
    for axis, classes, text in ((panels[0], EXACT, "Exact"), (panels[1], TOLERANT, "With tolerance")):
        image = mixed(places - low, shown.outcome, tuple(size), classes)
        axis.imshow(image, origin="lower", extent=extent, interpolation="nearest")
        title(axis, text)
        measured(axis, names)
    _legend(figure)
    return png_of(figure, DPI)


def mixed(
    places: NDArray[np.integer],
    outcome: NDArray[np.uint8],
    size: tuple[int, ...],
    classes: Mapping[str, tuple[str, list[Outcome]]],
) -> NDArray[np.float64]:
    """Return an image (rows, columns, 3): each pixel has the mean colour of its cells, white if there are none.

    places: (M, 2) column and row of each cell; cells without a class are not drawn.
    """
    from matplotlib.colors import to_rgb

    columns, rows = size
    number, colour = np.zeros(rows * columns), np.zeros((rows * columns, 3))
    for name, members in classes.values():
        x, y = places[np.isin(outcome, members)].T
        count = np.bincount(y * columns + x, minlength=rows * columns)
        number += count
        colour += count[:, None] * np.array(to_rgb(name))
    image = np.where(number[:, None] > 0, colour / np.maximum(number, 1)[:, None], 1.0)
    return image.reshape(rows, columns, 3)


def _legend(figure: Any) -> None:
    from matplotlib.patches import Patch

    patches = [Patch(fc=colour, ec="#888", label=name) for name, (colour, _) in EXACT.items()]
    figure.legend(handles=patches, loc="outside lower center", ncols=4, frameon=False, fontsize=10.5)
