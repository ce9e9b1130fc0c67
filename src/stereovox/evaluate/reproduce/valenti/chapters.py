# SPDX-License-Identifier: Apache-2.0
"""The evaluation told: Table 8.1 beside ours, one chapter a drive, and the time it takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stereovox.evaluate.reproduce.chapter import Chapter, Claim, Sheet, Shown
from stereovox.evaluate.reproduce.valenti.claims import CLAIMED, KINDS, claims_of, speed_claim
from stereovox.evaluate.reproduce.valenti.judge import Judged
from stereovox.evaluate.reproduce.valenti.mappers import DEFAULT, OCTOMAP, THESIS, Setting
from stereovox.evaluate.reproduce.valenti.sheets import (
    points_sheet,
    probabilities_sheet,
    row_of,
    targets_sheet,
    text_of,
    thresholds_sheet,
)
from stereovox.evaluate.reproduce.valenti.speed import Speed
from stereovox.evaluate.reproduce.valenti.table81 import PRINTED
from stereovox.view.evaluation import curves_png, series_png
from stereovox.view.outcomes import outcomes_png
from stereovox.view.reproduce.valenti import reliabilities_png, tolerances_png

TABLE = ("tp", "fp", "tn", "fn", "accuracy", "precision", "recall", "specificity", "npv", "error", "correlation")
TRUTH = (
    "Truth: a cell is occupied where one lidar point of any frame falls into it that is in the left image and on "
    "nothing annotated as an object. Cells count that some frame has in view and in range. Free are all others; "
    "beside it stands a second, kinder truth, whose free cells are only those that a lidar ray crossed. The first "
    "blames a map for every surface that the sparse lidar missed, the second asks only where the lidar knows."
)
OTHER_DATA = (
    "The thesis's rows are its own printed figures, of other drives than ours unless sequences 0000 to 0009 of the "
    "tracking data stand below them; the thesis tells neither the cell size nor the range of its table."
)
MEASURES = (
    "Exact and within one cell: a cell called occupied is right where the truth has a surface in it, or within one "
    "cell along each axis; recall likewise. The thesis's rule is p > 0.7; one hit leaves a cell of OctoMap at 0.7, so "
    "p >= 0.7 is told as well. Balanced: the threshold at which the lesser of precision and recall within one cell is "
    "largest. Cells never observed count as free; error and calibration are over observed cells, as in the thesis."
)
ALL_CELLS = (
    "The correlation over all cells of the truth has no target: cells that a map never observed stand at p = 0.5, most "
    "of them behind surfaces, so it mostly tells how much of the box was never seen, the more so the surer a map is "
    "of the free air that it did see."
)
RIVAL = (
    "OctoMap (octomap-python, its own settings, one ray for the points of a cell) gets the points of the same "
    "disparities as `default`, and pixels beyond the range clear their rays up to it. Its range is a distance, ours a "
    "depth; points in the image's corners between the two are marked occupied for it all the same."
)
FIG_8_4 = (
    "Recall and correlation rise while the drive goes on and more of the scene is seen; precision and error stay about "
    "level."
)
BETTER = (
    "Claims are made against the first truth, free is all in view. Better in every measure (f): each map is taken at "
    "the threshold that suits it best, and of precision and recall the lesser counts."
)


def table_chapter(judged: Sequence[Judged], setting: Setting, missing: str) -> Chapter:
    """Return Table 8.1 beside the same of all drives at one setting. missing: why there is no OctoMap."""
    shown = [one for one in judged if one.setting == setting]
    rows = [(f"{one.drive}, {one.mapper}", *row_of(vars(one.scores[CLAIMED]), TABLE)) for one in shown]
    thesis = [(f"thesis, {row.sequence}", *row_of(vars(row), TABLE)) for row in PRINTED]
    rows += [(f"{OCTOMAP}: {missing}", *["-"] * len(TABLE))] if missing else []
    claims = [_beside(one, name) for one in shown if one.mapper == THESIS for name in TABLE[4:]]
    return Chapter(
        "table81",
        "Table 8.1",
        f"Final results at p > 0.7, unobserved cells counted as free. Ours: {setting}. {OTHER_DATA}",
        claims,
        sheets=[Sheet("Thesis, Table 8.1, and ours", ("sequence", *TABLE), [*thesis, *rows])],
        remarks=[TRUTH],
        numbers={"thesis": [vars(row) for row in PRINTED]},
    )


def drive_chapter(name: str, judged: Sequence[Judged], counts: Mapping[str, Any], missing: str) -> Chapter:
    """Return all about one drive. counts: what became of the lidar's points, by setting; missing: as above."""
    frames = max(one.frames for one in judged)
    sheets = [points_sheet(judged, kind, missing) for kind in KINDS]
    sheets += [probabilities_sheet(judged), thresholds_sheet(judged), targets_sheet(judged)]
    method = (
        f"{frames} stereo pairs, mapped at {len({one.setting for one in judged})} settings. Truth: as in chapter 1."
    )
    return Chapter(
        f"drive_{name}",
        f"Drive {name}",
        method,
        claims_of(judged),
        list(_shown(judged)),
        sheets,
        [MEASURES, ALL_CELLS, RIVAL, BETTER],
        {"maps": [one.numbers() for one in judged], "lidar": counts, "missing": missing},
    )


def speed_chapter(speeds: Sequence[Speed]) -> Chapter:
    """Return how fast it is."""
    parts = ("read", "match", "prepare", "map")
    rows = [
        (one.profile, one.image, one.frames, one.cores, f"{one.hertz:.1f}",
         *(f"{one.ms[part]['median']:.1f} ({one.ms[part]['p90']:.1f})" for part in parts))
        for one in speeds
    ]  # fmt: skip
    heads = ("profile", "image", "frames", "cores", "frames a second", *(f"{part}, ms (90 %)" for part in parts))
    method = (
        "From image files to the updated map, two threads; files are read ahead beside the rest. Second of two passes. "
        "The claim is meant for a machine that does nothing else: fewer cores or other work make it slower."
    )
    sheets = [Sheet("Where the time goes", heads, rows)]
    numbers = {"speeds": [one.numbers() for one in speeds]}
    return Chapter("speed", "Time", method, [speed_claim(one) for one in speeds], (), sheets, numbers=numbers)


def _beside(one: Judged, name: str) -> Claim:
    printed = [getattr(row, name) for row in PRINTED]
    text = f"{one.drive}, profile {THESIS}, {one.setting}: {name}"
    return Claim(text, f"{min(printed):.3f} to {max(printed):.3f}", text_of(getattr(one.scores[CLAIMED], name)), None)


def _shown(judged: Sequence[Judged]) -> list[Shown]:
    pictures = [
        Shown("Precision and recall within one cell", "",
              "Each line is one map at all thresholds, truth: free is all in view; dots: p > 0.7, rings: p >= 0.7. "
              "The green corner is the target.", tolerances_png(judged)),
        Shown("Can the probabilities be believed?", "",
              "Of all observed cells with a probability, the share that is truly occupied. Below the dashed line a map "
              "claims too much.", reliabilities_png(judged)),
    ]  # fmt: skip
    for one in judged:
        if one.series is not None and len(one.series["frame"]):
            thesis = one.mapper == THESIS
            place = "Fig 8.4" if thesis else f"Frame by frame, {one.mapper}, {one.setting}"
            ours = f"{one.mapper}, {one.setting}, after each frame, against the truth of the whole drive."
            pictures.append(Shown(place, FIG_8_4 if thesis else "", ours, series_png(one.series)))
        if one.mapper == DEFAULT and one.shown is not None and len(one.shown.cells):
            pictures.append(Shown(f"Right and wrong from above, {one.mapper}, {one.setting}", "",
                                  "Columns in the mixed colours of their cells.", outcomes_png(one.shown)))  # fmt: skip
            pictures.append(Shown(f"Thresholds, ROC and reliability, {one.mapper}, {one.setting}", "",
                                  "Truth: free is all in view.", curves_png(one.scores[CLAIMED])))  # fmt: skip
    return pictures
