# SPDX-License-Identifier: Apache-2.0
"""Differences of two 2-D maps: the binary image of IST 2019, Fig 6 and 9, and one with the kinds of difference."""

from __future__ import annotations

import io
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.grids.grid_lattice import AlignedGrids, three_states
from stereovox.evaluate.grids.grid_scores import Difference, differences, wrong
from stereovox.maps import State
from stereovox.view.figures import blank, png_of
from stereovox.view.grid import Box, bounds, framed, paint, plan
from stereovox.view.panels import title

DPI = 140
WIDTH = 12.0
"""Inches."""
BOTH_FREE, BOTH_OCCUPIED, BOTH_UNKNOWN = 10, 11, 12
"""Classes of cells that do not differ."""
KINDS = {
    BOTH_UNKNOWN: ("unknown to both", "#cfd4db"),
    BOTH_FREE: ("both free", "#eef1f4"),
    Difference.FORGIVEN: ("differs, but excluded", "#9bc59d"),
    Difference.MISSED: ("missed: only the reference knows", "#8fb8de"),
    Difference.EXTRA: ("extra: only the map knows", "#e9c46a"),
    BOTH_OCCUPIED: ("both occupied", "#5a6577"),
    Difference.WRONGLY_FREE: ("wrongly free", "#8b1e5b"),
    Difference.WRONGLY_OCCUPIED: ("wrongly occupied", "#d1603d"),
}
"""Name and colour; if one pixel covers several cells, the last of these is shown."""


def binary_png(laid: AlignedGrids) -> bytes:
    """Return a PNG with one pixel per cell, north up: white where the maps differ, else black (IST 2019)."""
    from matplotlib.image import imsave

    out = io.BytesIO()
    imsave(out, wrong(differences(laid))[::-1], cmap="gray", vmin=0, vmax=1, format="png")
    return out.getvalue()


def classes(laid: AlignedGrids) -> NDArray[np.uint8]:
    """Return for each cell, (rows, columns) uint8, its `Difference`, or if there is none the common state."""
    found = differences(laid)
    same = np.full(len(State), BOTH_UNKNOWN, np.uint8)
    same[State.FREE], same[State.OCCUPIED] = BOTH_FREE, BOTH_OCCUPIED
    return np.where(found == Difference.SAME, same[three_states(laid.reference)], found)


def difference_png(laid: AlignedGrids) -> bytes:
    """Return a PNG with the kinds of difference in colours, in metres of the reference's frame."""
    box = _box(laid)
    figure, (axis,) = _panels(box, 1)
    paint(axis, laid.reference, classes(laid), {int(kind): colour for kind, (_, colour) in KINDS.items()})
    axis.set_facecolor(KINDS[BOTH_UNKNOWN][1])
    framed(axis, box)
    _legend(figure)
    return png_of(figure, DPI)


def side_by_side_png(laid: AlignedGrids, names: tuple[str, str] = ("Reference", "Map")) -> bytes:
    """Return a PNG of the reference, the map, and the binary difference (white: an error), all in one frame."""
    box = _box(laid)
    figure, panels = _panels(box, 3)
    max_px = int(0.74 * DPI * WIDTH) // (1 if _is_wide(box) else 3)
    for axis, grid in zip(panels, (laid.reference, laid.map), strict=False):
        plan(axis, grid, max_px=max_px)
    paint(panels[2], laid.reference, wrong(differences(laid)).astype(np.uint8), {0: "black", 1: "white"}, max_px)
    panels[2].set_facecolor("black")
    for axis, name in zip(panels, (*names, "Difference (white: an error)"), strict=True):
        axis.set(xlim=(box[0][0], box[1][0]), ylim=(box[0][1], box[1][1]))
        title(axis, name)
    return png_of(figure, DPI)


def _box(laid: AlignedGrids) -> Box:
    """Return the box of all cells known to either map."""
    box = bounds(replace(laid.reference, cells=np.maximum(laid.map.cells, laid.reference.cells)))
    return box if box is not None else (np.zeros(2), np.ones(2))


def _is_wide(box: Box) -> bool:
    width, height = box[1] - box[0]
    return bool(height < 0.5 * width)


def _panels(box: Box, number: int) -> tuple[Any, list[Any]]:
    """Return a figure with panels side by side or, for wide maps, stacked."""
    width, height = box[1] - box[0]
    rows, columns = (number, 1) if _is_wide(box) else (1, number)
    inches = float(np.clip(0.93 * WIDTH / columns * height / width, 1.6, 11.0)) + 0.7
    figure = blank(WIDTH, inches * rows + (0.8 if number == 1 else 0))
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def _legend(figure: Any) -> None:
    from matplotlib.patches import Patch

    patches = [Patch(fc=colour, ec="#888", label=name) for name, colour in KINDS.values()]
    figure.legend(handles=patches, loc="outside lower center", ncols=4, frameon=False, fontsize=10)
