# SPDX-License-Identifier: Apache-2.0
"""Report of an evaluation: a page with a table like Valenti 2018, Table 8.1, and explanations of the measures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate import decisions
from stereovox.evaluate.decisions import Outcomes
from stereovox.evaluate.scores import Scores
from stereovox.view.evaluation import curves_png, outcomes_png, series_png
from stereovox.view.report import page

TABLE = ("tp", "fp", "tn", "fn", "accuracy", "precision", "recall", "specificity", "npv", "error", "correlation")
"""Columns of Table 8.1."""
MORE = ("threshold", "tolerance_precision", "tolerance_recall", "f_score_1", "f_score_2", "iou", "coverage")
AS_PROBABILITIES = ("auc", "average_precision", "error", "ece", "ece_likely", "ece_equal_mass", "correlation")
HEADS = {
    "tolerance_precision": "precision, tolerant",
    "tolerance_recall": "recall, tolerant",
    "coverage": "observed",
    "f_score_1": "F-score, 1 cell",
    "f_score_2": "F-score, 2 cells",
    "iou": "IoU",
    "average_precision": "average precision",
    "ece_likely": "ece, p >= 0.3",
    "ece_equal_mass": "ece, equal mass",
}
DECIDED = (
    "Free means that a robot may drive there. So the fatal error is a surface called free; worse, with nothing "
    "tentative or occupied next to it. A robot stops for what is occupied, and often for what is tentative or unknown. "
    "The map decides by its own thresholds; only cells count that the truth knows."
)
BY_PARTS = (
    "Range is the distance to the nearest camera position. Thickness is that of the truth's surface: a "
    "line is one or two cells across in two directions, like a pole or a wire; a sheet in one, like a wall; bulk in "
    "none. Looks are the places of the map's path, at least 5 cm or 0.1 rad apart, from which the cell could be seen."
)
MEANINGS = {
    "tp, fp, tn, fn": "Cells the map calls occupied rightly and wrongly, and cells it calls free rightly and wrongly.",
    "accuracy": "The share of all cells the map is right about. Most cells are free, so an empty map scores high.",
    "precision": "Of the cells the map calls occupied, the share that a surface really touches. Walls drawn too thick "
    "cost precision.",
    "recall": "Of the cells that a surface touches, the share the map calls occupied. What the camera never saw costs "
    "recall.",
    "specificity": "Of the cells that are really free, the share the map does not call occupied.",
    "npv": "Negative predictive value: of the cells the map does not call occupied, the share that are free.",
    "tolerant": "A cell called occupied is forgiven, and a surface cell counts as found, where the other map has an "
    "occupied cell within the tolerance. A surface that lies near the border of two cells is no real error.",
    "error": "Mean squared difference of probability and truth over the observed cells (Brier score): 0 is perfect, "
    "0.25 is what 'I do not know' everywhere would get.",
    "correlation": "Pearson's correlation of probability and truth: 1 is perfect, 0 says nothing. Cells never observed "
    "count with p = 0.5.",
    "observed": "The share of the truth's cells about which the map says anything at all.",
    "ece": "Expected calibration error: how far, on average, a probability lies from the share of cells with it that "
    "are truly occupied.",
    "ece, p >= 0.3": "The same over the cells with p >= 0.3. Most cells are free and surely so, which hides errors "
    "of the others in the figure for all.",
    "ece, equal mass": "The same in ten bins of equally many cells, in place of ten of equal width.",
    "IoU": "Intersection over union: the cells that map and truth both call occupied, of those that either does.",
    "F-score": "Harmonic mean of tolerant precision and recall, within one cell and within two.",
    "average precision": "Area under precision against recall, exact, over all thresholds: 1 is perfect, the share of "
    "surface cells is guessing.",
    "auc": "How often a surface cell has a higher probability than a free one: 0.5 is guessing, 1 is perfect.",
}
WHERE = (
    "Seen from above, each column in the mixed colours of its cells. Blue is right, orange is only in the map, "
    "purple is missed though observed, grey was never observed. The second picture forgives errors of at most {}."
)
FRAMES = (
    "As in Valenti 2018, Fig 8.4: the map after each frame against the truth of the whole recording. Recall and "
    "correlation rise while new parts come into view; precision and error describe the part already mapped."
)
CURVES = (
    "How careful should a map be before it calls a cell occupied, and can its probabilities be trusted? Dotted lines "
    "are exact, full lines forgive errors within the tolerance. Cells never observed are never called occupied; in the "
    "ROC they stand at p = 0.5."
)


@dataclass(frozen=True, eq=False)
class Evaluated:
    """One result of the page.

    name: of the map or recording; series: measures by name against `frame` as `ScoreSeries.arrays` returns them, or
    None; outcomes: cells for the picture, or None.
    """

    name: str
    scores: Scores
    series: Mapping[str, NDArray[Any]] | None = None
    outcomes: Outcomes | None = None


def write_evaluation_report(
    folder: str | Path, results: Sequence[Evaluated], truth: str, heading: str = "How good is the map?"
) -> Path:
    """Write `evaluation.html` into `folder`, created if missing, and return its path.

    truth: name of the reference. Raises StereovoxError without any result and if the page
    cannot be written.
    """
    return page.write_page(folder, "evaluation.html", evaluation_page(results, truth, heading))


def evaluation_page(results: Sequence[Evaluated], truth: str, heading: str = "How good is the map?") -> str:
    """Return the page as text; see `write_evaluation_report`."""
    if not results:
        raise StereovoxError("no result to report; evaluate at least one map")
    first = results[0].scores
    within = "1 cell" if first.tolerance_cells == 1 else f"{first.tolerance_cells} cells"
    return page.page(
        heading,
        f"Compared cell by cell with {truth}. A cell is called occupied where its probability is above "
        f"{first.threshold:g}; an error of at most {within} is forgiven where it says 'tolerant'.",
        *(part for one in results for part in _decisions(one)),
        page.tiles(_boxes(first)) if len(results) == 1 else "",
        *_tables(results),
        *(part for one in results for part in _result(one, within)),
        page.section("What the measures mean", "", page.table(["measure", "what it says"], MEANINGS.items())),
    )


def _boxes(scores: Scores) -> list[tuple[str, str]]:
    names = {
        "tolerance_precision": "precision, tolerant",
        "tolerance_recall": "recall, tolerant",
        "precision": "precision, exact",
        "recall": "recall, exact",
        "correlation": "correlation",
        "error": "error (Brier score)",
    }
    return [(_number(getattr(scores, name)), label) for name, label in names.items()]


def _decisions(one: Evaluated) -> Iterable[str]:
    found, tolerance = one.scores.decisions, one.scores.tolerance_cells
    yield page.section(
        f"What it decides: {one.name}",
        DECIDED,
        page.table(decisions.HEADS, decisions.state_rows(found)),
        "<p></p>",
        page.table(decisions.ERROR_HEADS, decisions.error_rows(found, tolerance)),
    )
    if one.scores.parts:
        rows = decisions.part_rows(one.scores.parts)
        yield page.section(
            f"By range, thickness and looks: {one.name}", BY_PARTS, page.table(decisions.PART_HEADS, rows)
        )


def _tables(results: Sequence[Evaluated]) -> Iterable[str]:
    heads = [HEADS.get(name, name) for name in TABLE]
    yield page.section(
        "All cells of the truth",
        "As in Valenti 2018, Table 8.1: a cell never observed counts as free. Error is over observed cells.",
        page.table(["map", *heads], ([one.name, *_row(one.scores, TABLE)] for one in results)),
    )
    yield page.section(
        "Observed cells only",
        "The same without the cells the map has never observed: how good are its statements?",
        page.table(["map", *heads], ([one.name, *_observed_row(one.scores)] for one in results)),
    )
    yield page.section(
        "With tolerance",
        "Exact cells are a hard test, since a surface near the border of two cells falls into either. These measures "
        "forgive that.",
        _table_of(MORE, results),
    )
    yield page.section(
        "As probabilities",
        "Without a threshold: does the map order cells rightly, and can its probabilities be trusted?",
        _table_of(AS_PROBABILITIES, results),
    )


def _table_of(names: Sequence[str], results: Sequence[Evaluated]) -> str:
    rows = ([one.name, *_row(one.scores, names)] for one in results)
    return page.table(["map", *(HEADS.get(name, name) for name in names)], rows)


def _result(one: Evaluated, within: str) -> Iterable[str]:
    if one.outcomes is not None and len(one.outcomes.cells):
        png = outcomes_png(one.outcomes)
        text = WHERE.format(within)
        yield page.section(f"Where it is right and wrong: {one.name}", text, page.figure(png, f"Top view, {one.name}"))
    if one.series is not None and len(one.series["frame"]):
        png = series_png(one.series)
        yield page.section(f"Frame by frame: {one.name}", FRAMES, page.figure(png, f"Against the frame, {one.name}"))
    png = curves_png(one.scores)
    yield page.section(f"Thresholds and probabilities: {one.name}", CURVES, page.figure(png, f"Charts of {one.name}"))


def _row(scores: Any, names: Sequence[str]) -> list[str]:
    return [_number(getattr(scores, name)) for name in names]


def _observed_row(scores: Scores) -> list[str]:
    return [_number(scores.error if name == "error" else getattr(scores.observed, name)) for name in TABLE]


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,}" if isinstance(value, int) else f"{value:.3f}"
