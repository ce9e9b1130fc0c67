# SPDX-License-Identifier: Apache-2.0
"""Chapters of the evaluation: Table 8.1 next to ours, one chapter per drive, and the times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from stereovox.evaluate.curves import TOLERANT
from stereovox.evaluate.scores import Scores
from stereovox.view.evaluation import curves_png, outcomes_png, series_png
from stereovox.view.figures import GREY, labels
from stereovox_lab.papers.chapter import NO, UNJUDGED, YES, Chapter, Sheet, Shown
from stereovox_lab.papers.pictures import OURS, SECOND, figure_of, png
from stereovox_lab.papers.valenti.apart import Apart
from stereovox_lab.papers.valenti.claims import CLAIMED, KINDS, TARGET_RANGE, TARGETS, claims_of, results, speed_claim
from stereovox_lab.papers.valenti.course import FRAMES, LEVEL, RISES, course_claims
from stereovox_lab.papers.valenti.figures import AT_LEAST, STRICT, at, figures
from stereovox_lab.papers.valenti.judge import BOX, Judged
from stereovox_lab.papers.valenti.mappers import DEFAULT, OCTOMAP, THESIS, Setting
from stereovox_lab.papers.valenti.printed import (
    PRINTED,
    TABLE,
    absent_claims,
    drive_claims,
    judged_rows,
    measured,
)
from stereovox_lab.papers.valenti.speed import Speed

VERDICTS = {True: YES, False: NO, None: UNJUDGED}
COLOURS = {THESIS: "#8a8f99", DEFAULT: OURS, OCTOMAP: SECOND}
TARGET = "#5b8c5a"
TRUTH = (
    "Truth: a cell is occupied where one lidar point of any frame falls into it that is in the left image and on "
    "nothing annotated as an object. Cells count that some frame has in view and in range. Free are all others; "
    "next to it stands a second, kinder truth, whose free cells are only those that a lidar ray crossed. The first "
    "blames a map for every surface that the sparse lidar missed, the second asks only where the lidar knows."
)
BOXES = (
    "The counts of the printed rows add up to round volumes (528,000; 4,224,000; ...): they are of whole boxes. Ours "
    "are judged over the box round all that a frame had in view. Most of its cells no camera sees; they are free, for "
    "map and truth, and so raise accuracy, specificity and negative predictive value. The cells in view alone stand "
    "next to them. Correlation is Eq 8.8 with unobserved cells as free (Eq 8.1); the last column has them at 0.5, with "
    "which a box that is mostly unobserved cannot reach the printed values."
)
AT_HALF = "correlation, unobserved at 0.5"
OURS_OF_TABLE = (*TABLE, AT_HALF)
CELLS = {BOX: "whole box", CLAIMED: "in view"}
OTHER_DATA = (
    "The thesis's rows are its own printed figures, of other drives than ours unless sequences 0000 to 0009 of the "
    "tracking data stand below them; the thesis gives neither the cell size nor the range of its table."
)
MEASURES = (
    "Exact and within one cell: a cell called occupied is right where the truth has a surface in it, or within one "
    "cell along each axis; recall likewise. The thesis's rule is p > 0.7; one hit leaves a cell of OctoMap at 0.7, so "
    "p >= 0.7 is reported. Balanced: the threshold at which the lesser of precision and recall within one cell is "
    "largest where thresholds are chosen, never where they are scored. Cells never observed count as free; error and "
    "calibration are over observed cells, as in the thesis."
)
ALL_CELLS = (
    "The thesis takes the correlation over all cells of the truth, unobserved ones at p = 0.5, and so it is counted "
    "here, next to that over observed cells. Most unobserved cells lie behind surfaces, so it also reports how much of "
    "the box was never seen, the more so the surer a map is of the free air that it did see."
)
RULES = (
    "Rules, the same for every drive. Own counts: a printed rate agrees with the counts of its row within "
    "its last digit, rounded or cut off. The profile valenti2018: over a whole drive it is no worse than the printed "
    "row of the same sequence, to half of the last digit; on a drive that the table has not, no worse than the worst "
    "of its ten rows. default: better than that row, or than the best of the ten. What cannot be judged is said to be "
    "so: the counts, which go with a cell size and a range that the thesis does not give, and sequences that are not "
    "at hand."
)
RIVAL = (
    "OctoMap (octomap-python, its own settings, one ray for the points of a cell) gets the points of the same "
    "disparities as `default`, and pixels beyond the range clear their rays up to it. Its range is a distance, ours a "
    "depth; points in the image's corners between the two are marked occupied for it all the same."
)
COURSE = (
    f"Fig 8.4: a measure rises if its rank correlation with the number of the frame is at least {RISES:g}; it stays "
    f"level if its means over the first and the last quarter of the frames are at most {LEVEL:g} apart. At least "
    f"{FRAMES} frames are asked for."
)
FIG_8_4 = (
    "Recall and correlation rise while the drive goes on and more of the scene is seen; precision and error stay about "
    "level."
)
BETTER = (
    "Claims are made against the first truth, free is all in view. Better in every measure (f): each map is taken at "
    "the threshold that suits it best where thresholds are chosen, and of precision and recall the lesser counts."
)


def points_sheet(maps: Sequence[Apart], kind: str, missing: str) -> Sheet:
    """Return precision and recall, scored apart, at fixed thresholds and the balanced one.

    missing: why there is no OctoMap.
    """
    heads = ("cell, range", "mapper", "p > 0.7: precision, recall", "within one cell", "p >= 0.7: precision, recall",
             "within one cell", "balanced at", "precision, recall", "within one cell")  # fmt: skip
    rows = []
    for one in maps:
        told = figures(one.scored[kind])
        fixed = [part for name in ("strict", "at_least") for part in _pairs(told[name])]
        point = one.point(kind, TOLERANT)
        balanced = (f"p > {point['threshold']:.4g}", *_pairs(point)) if point else ("-", "-", "-")
        rows.append((str(one.judged.setting), one.judged.mapper, *fixed, *balanced))
    if missing:
        rows.append(("all", OCTOMAP, missing, *["-"] * (len(heads) - 3)))
    return Sheet(f"Precision and recall of all maps; {KINDS[kind]}", heads, rows)


def probabilities_sheet(maps: Sequence[Apart]) -> Sheet:
    """Return the threshold-free measures, for both kinds of truth, over the scored part."""
    names = ("error", "corr., all cells", "corr., observed", "ECE", "share observed")
    heads = ("cell, range", "mapper", *(f"{kind}: {name}" for kind in KINDS for name in names))
    rows = []
    for one in maps:
        values = [
            text_of(value)
            for kind in KINDS
            for s in [one.scored[kind]]
            for value in (s.error, s.correlation, s.observed.correlation, s.ece, s.coverage)
        ]
        rows.append((str(one.judged.setting), one.judged.mapper, *values))
    return Sheet("Probabilities of all maps; view: free is all in view, rays: what the lidar looked into", heads, rows)


def thresholds_sheet(maps: Sequence[Apart]) -> Sheet:
    """Return precision and recall within one cell at several thresholds, over the scored part."""
    listed = [figures(one.scored[CLAIMED])["listed"] for one in maps]
    heads = ("cell, range", "mapper", *(f"p > {point['threshold']:g}" for point in listed[0]))
    rows = [
        (str(one.judged.setting), one.judged.mapper, *(_pairs(point)[1] for point in points))
        for one, points in zip(maps, listed, strict=True)
    ]
    return Sheet(f"Precision, recall within one cell by threshold; {KINDS[CLAIMED]}", heads, rows)


def targets_sheet(maps: Sequence[Apart]) -> Sheet:
    """Return each map's figures for the targets, even if nothing is claimed."""
    found = {(one.judged.setting, one.judged.mapper): one for one in maps}
    rows, heads = [], ()
    for (setting, mapper), kind in product(found, KINDS):
        if setting.voxel_size in TARGETS:
            told = results(found, setting, mapper, kind)
            heads = tuple(f"({one.letter}) {one.text}" for one in told)
            signs = (VERDICTS[one.holds] for one in told)
            rows.append((f"{setting}; {KINDS[kind]}", mapper, *map("{} {}".format, (o.ours for o in told), signs)))
    return Sheet(
        "What each map reaches of the targets (to 40 m none are set: those of 20 m)", ("map", "of", *heads), rows
    )


def _pairs(point: Mapping[str, float | None]) -> tuple[str, str]:
    exact = f"{text_of(point['precision'])}, {text_of(point['recall'])}"
    return exact, f"{text_of(point['tolerance_precision'])}, {text_of(point['tolerance_recall'])}"


def _measured(scores: Scores) -> dict[str, Any]:
    return {**{name: measured(scores, name) for name in TABLE}, AT_HALF: scores.correlation}


def row_of(values: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Return the values of these names as text."""
    return [text_of(values[name]) for name in names]


def text_of(value: float | None) -> str:
    """Return a number for a table: integers with commas, others with three digits."""
    if value is None:
        return "-"
    return f"{value:,}" if isinstance(value, int) else f"{value:.3f}"


def tolerances_png(maps: Sequence[Apart]) -> bytes:
    """Return precision against recall within one cell: a row per range, a column per cell size, a line per map."""
    return _charts(maps, _tolerance, ("recall within one cell", "precision within one cell"))


def reliabilities_png(maps: Sequence[Apart]) -> bytes:
    """Return the share of truly occupied cells against the probability, laid out as `tolerances_png`."""
    return _charts(maps, _reliability, ("probability the map gives", "share truly occupied"))


def _charts(maps: Sequence[Apart], draw: Callable[[Any, Apart], None], names: tuple[str, str]) -> bytes:
    sizes = sorted({one.judged.setting.voxel_size for one in maps}, reverse=True)
    ranges = sorted({one.judged.setting.max_range for one in maps})
    figure = figure_of(4.2 * len(ranges) + 0.4)
    axes = figure.subplots(len(ranges), len(sizes), squeeze=False)
    for one in maps:
        setting = one.judged.setting
        axis = axes[ranges.index(setting.max_range), sizes.index(setting.voxel_size)]
        draw(axis, one)
        axis.set_title(str(setting), fontsize=11, color=GREY)
    for axis in axes.ravel():
        labels(axis, *names)
    handles, texts = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=len(texts) or 1, frameon=False)
    return png(figure)


def _tolerance(axis: Any, one: Apart) -> None:
    curve, setting, mapper = one.scored["view"].curve, one.judged.setting, one.judged.mapper
    colour = COLOURS[mapper]
    axis.plot(curve.tolerance_recall, curve.tolerance_precision, color=colour, label=mapper)
    points = ((at(curve, STRICT), "o", colour), (at(curve, AT_LEAST), "o", "white"))
    for point, mark, face in (*points, (one.point("view", TOLERANT), "D", colour)):
        if point is not None:
            precision, recall = (np.nan if point[name] is None else point[name] for name in TOLERANT)
            axis.plot(recall, precision, mark, color=colour, markerfacecolor=face)
    target = TARGETS.get(setting.voxel_size) if setting.max_range == TARGET_RANGE else None
    if target is not None and mapper == DEFAULT:
        corner = ([target.recall, 1], [target.precision] * 2)
        axis.fill_between(*corner, 1, color=TARGET, alpha=0.35, linewidth=0)
    axis.set(xlim=(0.4, 1.01), ylim=(0.4, 1.01))


def _reliability(axis: Any, one: Apart) -> None:
    found, mapper = one.scored["view"].reliability, one.judged.mapper
    axis.plot([0, 1], [0, 1], "--", color=GREY, linewidth=1)
    axis.plot(found.mean_p, found.occupied_share, "o-", markersize=4, color=COLOURS[mapper], label=mapper)
    axis.set(xlim=(0, 1), ylim=(0, 1.02))


def table_chapter(judged: Sequence[Judged], setting: Setting, missing: str) -> Chapter:
    """Return Table 8.1 next to our rows of all drives at one setting. missing: why there is no OctoMap."""
    shown = [one for one in judged if one.setting == setting]
    rows = [(f"{one.drive}, {one.mapper}, {CELLS[kind]}", *row_of(_measured(one.scores[kind]), OURS_OF_TABLE))
            for one in shown for kind in CELLS]  # fmt: skip
    thesis = [(f"thesis, {row.sequence}", *row_of(vars(row), TABLE), "-") for row in PRINTED]
    rows += [(f"{OCTOMAP}: {missing}", *["-"] * len(OURS_OF_TABLE))] if missing else []
    drives = list(dict.fromkeys(one.drive for one in shown))
    return Chapter(
        "table81",
        "Table 8.1",
        f"Final results at p > 0.7, unobserved cells counted as free. Ours: {setting}. {OTHER_DATA}",
        [*drive_claims(shown, BOX), *absent_claims(drives)],
        sheets=[
            Sheet("Thesis, Table 8.1, and ours", ("sequence", *OURS_OF_TABLE), [*thesis, *rows]),
            Sheet("Each printed figure, judged", ("sequence", *TABLE), judged_rows(shown, BOX)),
        ],
        remarks=[BOXES, RULES, TRUTH],
        numbers={"thesis": [vars(row) for row in PRINTED]},
    )


def drive_chapter(maps: Sequence[Apart], counts: Mapping[str, Any], missing: str) -> Chapter:
    """Return the chapter on one drive. counts: use of the lidar's points, by setting; missing: as above."""
    judged = [one.judged for one in maps]
    name, frames = judged[0].drive, max(one.frames for one in judged)
    sheets = [points_sheet(maps, kind, missing) for kind in KINDS]
    sheets += [probabilities_sheet(maps), thresholds_sheet(maps), targets_sheet(maps)]
    method = (
        f"{frames} stereo pairs, mapped at {len({one.setting for one in judged})} settings. Truth: as in chapter 1. "
        f"Claims (a) to (f) and the tables: {maps[0].where}."
    )
    return Chapter(
        f"drive_{name}",
        f"Drive {name}",
        method,
        [*claims_of(maps), *course_claims(judged)],
        list(_shown(maps)),
        sheets,
        [MEASURES, ALL_CELLS, RIVAL, BETTER, COURSE],
        {"maps": [one.numbers() for one in maps], "lidar": counts, "missing": missing},
    )


def speed_chapter(speeds: Sequence[Speed]) -> Chapter:
    """Return the chapter on speed."""
    parts = ("read", "match", "prepare", "map")
    rows = [
        (one.profile, one.image, one.frames, one.cores, f"{one.hertz:.1f}",
         *(f"{one.ms[part]['median']:.1f} ({one.ms[part]['p90']:.1f})" for part in parts))
        for one in speeds
    ]  # fmt: skip
    heads = ("profile", "image", "frames", "cores", "frames a second", *(f"{part}, ms (90 %)" for part in parts))
    method = (
        "From image files to the updated map, two threads; files are read ahead meanwhile. Second of two passes. "
        "The claim is meant for a machine that does nothing else: fewer cores or other work make it slower."
    )
    sheets = [Sheet("Where the time goes", heads, rows)]
    numbers = {"speeds": [one.numbers() for one in speeds]}
    return Chapter("speed", "Time", method, [speed_claim(one) for one in speeds], (), sheets, numbers=numbers)


def _shown(maps: Sequence[Apart]) -> list[Shown]:
    pictures = [
        Shown("Precision and recall within one cell", "",
              "Each line is one map at all thresholds over the part that is scored, truth: free is all in view; dots: "
              "p > 0.7, rings: p >= 0.7, diamonds: the threshold chosen elsewhere. The green corner is the target.",
              tolerances_png(maps)),
        Shown("Are the probabilities correct?", "",
              "Of all observed cells with a probability, the share that is truly occupied. Below the dashed line a map "
              "claims too much.", reliabilities_png(maps)),
    ]  # fmt: skip
    for one in (each.judged for each in maps):
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
