# SPDX-License-Identifier: Apache-2.0
"""Report of a 2-D map against a reference: Eq 7 of IST 2019 with its difference image, and measures with tolerance."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stereovox.evaluate.grid_align import AlignedGrids
from stereovox.evaluate.grid_scores import GridScores
from stereovox.view.grid import binary_png, difference_png, side_by_side_png
from stereovox.view.report import page

LEAD = (
    "{} compared with {}, cell by cell, in cells of {:g} m of the reference. The error of IST 2019, Eq 7, counts every "
    "cell that differs: cells known to only one map (coverage), and cells with opposite states "
    "(contradiction). A wall displaced by one cell counts twice; the other measures distinguish it from a wrong one."
)
KINDS = {
    "missed": "Known to the reference, unknown to the map: never seen, or out of the sensor's range.",
    "wrongly_occupied": "Free in the reference, occupied in the map: a wall aside or too thick, or something new.",
    "wrongly_free": "Occupied in the reference, free in the map: a wall aside or lost.",
    "extra": "Known to the map, unknown to the reference.",
    "forgiven": "Different, but in an excluded region: counted as right.",
}
ALL = "Every cell the reference knows; one that the map does not know is not called occupied"
OBSERVED = "Cells known to both maps"
TALLY = ("cells", "tp", "fp", "tn", "fn", "accuracy", "precision", "recall", "specificity", "npv", "correlation")
DIFFERENCE = (
    "Light and dark grey are right. A pixel of several cells shows a wrong wall first. "
    "difference.png next to this page is the binary image with a pixel for each cell."
)


def write_grid_report(
    folder: str | Path, scores: GridScores, laid: AlignedGrids, name: str = "The map", reference: str = "the reference"
) -> Path:
    """Write `evaluation.html` and `difference.png`, one pixel per cell, into `folder`; return the page's path.

    name, reference: names of the maps. Raises StereovoxError if they cannot be written.
    """
    text = grid_page(scores, laid, name, reference)
    return page.write_files(folder, {"evaluation.html": text.encode(), "difference.png": binary_png(laid)})


def grid_page(scores: GridScores, laid: AlignedGrids, name: str, reference: str) -> str:
    """Return the page as text; see `write_grid_report`."""
    return page.page(
        "How good is the floor's map?",
        LEAD.format(name, reference, scores.resolution),
        page.tiles(_boxes(scores)),
        page.section("Both maps", "", page.figure(side_by_side_png(laid), "Reference, map and difference")),
        page.section("How they differ", DIFFERENCE, page.figure(difference_png(laid), "Kinds of differences")),
        *_tables(scores),
    )


def _boxes(scores: GridScores) -> list[tuple[str, str]]:
    return [
        (_percent(scores.eq7_percent), "error, IST 2019, Eq 7"),
        (_percent(scores.errors.eq7_coverage_percent), "of it coverage: only one of the maps knows the cell"),
        (_percent(scores.errors.eq7_contradiction_percent), "of it contradiction: free in one, occupied in the other"),
        (_percent(scores.errors.known_error_percent), "of the cells known to both differ"),
        (_metres(scores.to_reference.mean), "from a wall of the map to one of the reference, mean"),
        (_number(scores.occupied.iou_tolerant), f"overlap (IoU) of walls within {_within(scores)}"),
        (_number(scores.occupied.iou), "overlap (IoU) of walls, exact"),
        (_percent(scores.coverage and 100 * scores.coverage), "of the reference's cells known to the map"),
    ]


def _tables(scores: GridScores) -> Iterator[str]:
    errors = scores.errors
    known = errors.reference_occupied + errors.reference_free
    rows = [(kind.replace("_", " "), f"{getattr(errors, kind):,}", _percent(100 * getattr(errors, kind) / known), text)
            for kind, text in KINDS.items()]  # fmt: skip
    yield page.section(
        "What the error is made of",
        f"In per cent of the reference's {errors.reference_occupied:,} occupied and {errors.reference_free:,} free "
        "cells, as in Eq 7; the first four add up to it: missed and extra to its coverage, the two wrong ones to its "
        "contradiction. Cells between free and occupied count as unknown.",
        page.table(["cells", "number", "of Eq 7", "what they are"], rows),
    )
    yield page.section("Walls", _moved(scores), page.table(["measure", "value", "what it says"], _walls(scores)))
    yield page.section(
        "Occupied or not",
        "Positive: the map calls a cell occupied. A wall one cell aside is wrong twice here.",
        page.table(
            ["over", *TALLY],
            ([text, *(_number(getattr(tally, field)) for field in TALLY)]
             for text, tally in ((ALL, scores.tally), (OBSERVED, scores.observed))),
        ),
    )  # fmt: skip


def _walls(scores: GridScores) -> list[tuple[str, str, str]]:
    walls, within = scores.occupied, _within(scores)
    rows = [
        ("IoU, exact", _number(walls.iou), "occupied cells of both / of either"),
        (f"IoU, within {within}", _number(walls.iou_tolerant), "the same, a neighbour is enough"),
        ("precision", _number(walls.tolerance_precision), f"of the map's occupied cells have one within {within}"),
        ("recall", _number(walls.tolerance_recall), f"of the reference's occupied cells have one within {within}"),
        ("IoU of free cells", _number(scores.free_iou), "free cells of both / of either"),
        ("error (Brier)", _number(scores.error), "mean squared error of the probabilities over cells known to both"),
    ]
    for figures, text in ((scores.to_reference, "from the map's walls"), (scores.from_reference, "to the map's walls")):
        values = ", ".join(f"{what} {_metres(getattr(figures, what))}" for what in ("mean", "median", "p95", "max"))
        rows.append((f"distance {text}", values, "to the nearest occupied cell of the other map"))
    return rows


def _moved(scores: GridScores) -> str:
    if not scores.aligned and not np.any(scores.motion):
        return "The maps were compared as they stand, in one frame."
    x, y, yaw = scores.motion
    by = f"{x:.3f} m in x, {y:.3f} m in y and {np.degrees(yaw):.2f} degrees"
    return f"The map was moved by {by} " + ("to lie best on the reference." if scores.aligned else "as asked.")


def _within(scores: GridScores) -> str:
    return "1 cell" if scores.tolerance_cells == 1 else f"{scores.tolerance_cells} cells"


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f} m"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} %"


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,}" if isinstance(value, int) else f"{value:.3f}"
