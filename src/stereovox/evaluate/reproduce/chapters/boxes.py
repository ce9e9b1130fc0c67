# SPDX-License-Identifier: Apache-2.0
"""Experiment 1 told: a large and a small box at 2 m, and boxes at random places (Chien 2020, 4.4.1)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereovox.evaluate.reproduce.boxes import DIRECTIONS, BoxFound
from stereovox.evaluate.reproduce.chapter import Chapter, Claim, Sheet, Shown
from stereovox.view.reproduce.boxes import box_png, placements_png, space_png

SIZES_CM = {"large": "47 x 36.5 x 32 cm", "small": "25 x 18.5 x 9 cm"}
FIGURES = {"large": ("Fig 4.6", "Fig 4.7"), "small": ("Fig 4.9", "Fig 4.10")}
SAID = {
    "large": "The box occupies two cells. Only 3.5 cm of it lie in each outer cell, whose rays mostly pass by. The "
    "wall behind it is fully obstructed and has no update results.",
    "small": "The small box also occupies two cells, although it is 22 cm narrower: 12.5 cm of it lie in each, more "
    "than half of the cell. It barely blocks the wall.",
}
NAMES = {"line": "line drawing", "ray": "voxel traversal"}
MARGIN = (
    "The accuracy is practical for the positions of obstacles but not for exact dimensions, therefore a margin of one "
    "cell is required (chapter 5)."
)
WHY = (
    "Why two cells: in an outer cell of the large box most rays pass by and win; in each of the small box's cells "
    "enough rays end. The front of both stands exactly on the border of two cells, and the nearest of 64 noisy "
    "pixels is some centimetres too near, so the front also appears in the cell before it (front +1)."
)
OPEN = (
    "Not given in the thesis: k and p_min of Eq 3.3 and the value at which it is clamped. Here they are chosen so that "
    "both boxes come out two cells wide: k = 0.05 m, p_min = 0.25, clamp 0.93. A cell then becomes occupied when a bit "
    "less than a third of its rays end in it."
)


def chapter(two: Sequence[BoxFound], many: Sequence[BoxFound], updates: int) -> Chapter:
    """Return the chapter. two: the thesis's boxes at 2 m, each by line and ray; many: random placements."""
    of_size = {size: [one for one in two if one.placement.size == size] for size in FIGURES}
    tracers = list(dict.fromkeys(one.integrator for one in many))
    claims = [*(_width(size, of_size[size]) for size in FIGURES), _shadow("the large box", of_size["large"])]
    claims += [_placed(name, [one for one in many if one.integrator == name]) for name in tracers]
    claims.append(_shadow("the large boxes at random places", [one for one in many if one.placement.size == "large"]))
    shown = [picture for size in FIGURES for picture in _pictures(size, of_size[size])]
    ours = "How far each side is off, over all boxes at random places; +1 means one cell further out than the truth."
    numbers = {"updates": updates, "at_2_m": [one.figures() for one in two], "random": [one.figures() for one in many]}
    return Chapter(
        "boxes",
        "Large and small box at 2 m",
        f"A simulated D435 stands before a box that hangs in the air: {updates} updates, cells of 0.2 m, a wall 4.1 m "
        "away. The camera stands at a corner of cells, as in the thesis, where the boxes lie evenly on both sides of "
        f"the axis. Then {len(many) // len(tracers)} boxes of both sizes at random places in view, at least 1 m away "
        "and 0.6 m clear of wall and floor. Every occupied cell that is not near wall or floor counts as box, "
        "wherever it is. A side is off by the number of cells from the cell that holds the true side to the "
        "outermost occupied one.",
        claims,
        [*shown, Shown("Chapter 5", MARGIN, ours, placements_png(many))],
        [_errors(tracers, many)],
        [*_broken(many), WHY, OPEN],
        numbers,
    )


def _width(size: str, found: Sequence[BoxFound]) -> Claim:
    ours = ", ".join(f"{one.width} ({NAMES[one.integrator]})" for one in found)
    text = f"{size.capitalize()} box ({SIZES_CM[size]}): cells side by side"
    return Claim(text, "2", ours, all(one.width == 2 for one in found))


def _shadow(whose: str, found: Sequence[BoxFound]) -> Claim:
    hidden, known = sum(one.hidden for one in found), sum(one.hidden_known for one in found)
    ours = f"{hidden - known:,} of {hidden:,} cells unknown"
    return Claim(
        f"What lies in the shadow of {whose}, the wall too, stays unknown", "no update results", ours, known == 0
    )


def _placed(name: str, found: Sequence[BoxFound]) -> Claim:
    good = sum(one.within_one_cell for one in found)
    text = f"Random places, {NAMES[name]}: the box is there and no side is more than one cell off"
    return Claim(text, "one cell of margin", f"{good} of {len(found)} boxes", good == len(found))


def _pictures(size: str, found: Sequence[BoxFound]) -> list[Shown]:
    by_name = {one.integrator: one for one in found}
    line, ray = by_name["line"], by_name["ray"]
    plan, space = FIGURES[size]
    ours = (
        "The layer of cells below the camera's height by both tracers, with the true box in red; cell values along the "
        "optical axis and of the whole layer by line drawing. 127 is unknown, 0 free, 255 occupied."
    )
    return [
        Shown(plan, SAID[size], ours, box_png(line, ray)),
        Shown(space, "The 3-D map; red lines are the field of view with 1 m depth.", "The same, by line drawing.",
              space_png(line.voxel_map, f"{size.capitalize()} box at 2 m")),
    ]  # fmt: skip


def _errors(tracers: Sequence[str], many: Sequence[BoxFound]) -> Sheet:
    """Return how many boxes are off by so many cells, side by side."""
    rows = []
    for name in tracers:
        errors = np.array([one.errors for one in many if one.integrator == name and one.errors is not None])
        for value in range(int(min(errors.min(), -1)), int(max(errors.max(), 1)) + 1):
            rows.append((NAMES[name], f"{value:+d}" if value else "0", *(errors == value).sum(axis=0).tolist()))
    return Sheet("Boxes at random places: how many are off by so many cells", ("tracer", "cells", *DIRECTIONS), rows)


def _broken(many: Sequence[BoxFound]) -> list[str]:
    """Return one paragraph for each placement that breaks the claim."""
    told = []
    for one in many:
        if not one.within_one_cell:
            place = one.placement
            where = (
                f"{place.size} box at {place.distance:g} m, x {place.x:g}, y {place.y:g}, by {NAMES[one.integrator]}"
            )
            told.append(f"Breaks the claim: {where}: {_why(one)}.")
    return told or ["No box breaks the claim."]


def _why(one: BoxFound) -> str:
    if one.errors is None:
        return "not one cell is occupied; it fills less than a third of each cell that it touches"
    sides = zip(DIRECTIONS, one.errors.tolist(), strict=True)
    return "off by " + ", ".join(f"{value:+d} {side}" for side, value in sides if abs(value) > 1) + " cells"
